"""Pose estimation with Mitsuba's `direct_projective` integrator and an area light in place of the directional one.

`MitsubaPose` has the interface of the other methods of the pose experiment. `find_fair_setting` searches the cheapest
sample counts with which it converges; what it found is stored in `fair_settings.json`, read by `fair_setting` and
extended by ``python -m mitsuba_baselines.pose --search RESOLUTION``.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from shadowmap_dr import assets
from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.inverse.pose import apply_pose

from .proxy import Proxy, calibrate, with_proxy
from .reference import path_traced

STORE = Path(__file__).with_name("fair_settings.json")
GUIDINGS = ("none", "grid", "octree")


@dataclass(frozen=True, order=True)
class ProjectiveSetting:
    """Samples per pixel of Mitsuba's projective integrators.

    Attributes:
        sppc: For the continuous part of the derivative, and for the image in the loss.
        sppp: For silhouettes as the camera sees them.
        sppi: For silhouettes as the light sees them, which move shadows.
        guiding: "none", "grid" or "octree" (Mitsuba's default, rebuilt at every step).
    """

    sppc: int
    sppp: int
    sppi: int
    guiding: str = "none"

    def __post_init__(self) -> None:
        if self.guiding not in GUIDINGS:
            raise ShadowmapError(f"guiding {self.guiding!r}: choose from {', '.join(GUIDINGS)}.")
        if min(self.sppc, self.sppp, self.sppi) < 1:
            raise ShadowmapError(f"sample counts {self.sppc}/{self.sppp}/{self.sppi}: each must be at least 1.")

    def __str__(self) -> str:
        return f"{self.sppc}/{self.sppp}/{self.sppi} {self.guiding}"


class MitsubaPose:
    """Fits the pose of a mesh to a reference image with Mitsuba's projective integrator and Adam.

    Args:
        scene_path: XML scene with the parameters `$object` and `$resolution` and the ids `object`, `wall`, `light` (a
            directional light) and `camera`, such as `scenes/pose.xml`.
        mesh_path: Mesh file of the object.
        resolution: Width and height of the image.
        setting: Sample counts and guiding.
        reference: (H, W, C) linear image to fit.
        step_size, betas: Of Adam.
        seed: Of the sampling; step i uses seeds of its own.
        shift_z: Constant offset in z on top of the pose.
        proxy: Area light to use; default: calibrated here for this scene and resolution.

    Raises:
        ShadowmapError: The reference's shape does not fit the resolution, or see `proxy.calibrate`.
    """

    def __init__(
        self,
        scene_path: str | Path,
        mesh_path: str | Path,
        resolution: int,
        setting: ProjectiveSetting,
        reference: npt.ArrayLike,
        step_size: float = 0.01,
        betas: tuple[float, float] = (0.9, 0.999),
        seed: int = 0,
        shift_z: float = 0.0,
        proxy: Proxy | None = None,
    ) -> None:
        image = np.asarray(reference, np.float32)
        if image.ndim != 3 or image.shape[:2] != (resolution, resolution) or not np.isfinite(image).all():
            raise ShadowmapError(f"a reference of shape {image.shape}: give finite values of shape "
                                 f"({resolution}, {resolution}, C).")
        self.setting, self.step_size, self.betas, self.seed, self.shift_z = setting, step_size, betas, seed, shift_z
        scene = mi.load_file(str(scene_path), optimize=False, object=str(mesh_path), resolution=resolution)
        params = mi.traverse(scene)
        self._rest = mi.Float(params["object.vertex_positions"])
        params["object.vertex_positions"] = apply_pose(self._rest, dr.zeros(mi.Float, 3), shift_z)
        params.update()
        self.proxy = calibrate(scene) if proxy is None else proxy
        self._scene = with_proxy(scene, self.proxy)
        self._params = mi.traverse(self._scene)
        self._sensor = self._scene.sensors()[0]
        self._reference = mi.TensorXf(image)
        self._integrator = mi.load_dict({
            "type": "direct_projective", "sppc": setting.sppc, "sppp": setting.sppp, "sppi": setting.sppi,
            "guiding": setting.guiding,
        })
        self.reset((0.0, 0.0, 0.0))

    def reset(self, start: npt.ArrayLike) -> None:
        """Starts anew at (rotation in radians, x, y) with empty moments."""
        self.load_state({"parameters": np.asarray(start, np.float64), "m": np.zeros(3), "v": np.zeros(3),
                         "t": np.zeros(1, np.int64)})

    def step(self) -> float:
        """One step of Adam. Returns the loss before it: the mean squared difference of linear colours."""
        loss, gradient = self.loss_and_gradient(self._parameters)
        beta1, beta2 = self.betas
        self._t += 1
        self._m = beta1 * self._m + (1 - beta1) * gradient
        self._v = beta2 * self._v + (1 - beta2) * gradient**2
        mean, variance = self._m / (1 - beta1**self._t), self._v / (1 - beta2**self._t)
        self._parameters = self._parameters - self.step_size * mean / (np.sqrt(variance) + 1e-8)
        return loss

    def loss_and_gradient(self, parameters: npt.ArrayLike) -> tuple[float, np.ndarray]:
        """Loss and its (3,) estimated gradient at a pose. The state stays as it is, but for the mesh in the scene.

        The image in the loss and the derivative use different random numbers, else the gradient were biased.
        """
        pose = mi.Float(np.asarray(parameters, np.float32))
        dr.enable_grad(pose)
        self._place(pose)
        seeds = np.random.SeedSequence((self.seed, self._t)).generate_state(2)
        with dr.suspend_grad():
            image = self._integrator.render(self._scene, sensor=self._sensor, seed=int(seeds[0]), spp=self.setting.sppc)
            difference = dr.detach(image) - self._reference
            count = difference.array.shape[0]
            loss = dr.sum(dr.square(difference.array)) / count
        self._integrator.render_backward(
            self._scene, self._params, difference * (2 / count), sensor=self._sensor, seed=int(seeds[1]), spp=0)
        return float(loss[0]), np.array(dr.grad(pose), dtype=np.float64)

    def parameters(self) -> np.ndarray:
        """(3,) rotation in radians, x, y."""
        return self._parameters.copy()

    def render(self, parameters: npt.ArrayLike, spp: int = 64) -> np.ndarray:
        """(H, W, C) float32 linear image at a pose, lit by the proxy."""
        self._place(mi.Float(np.asarray(parameters, np.float32)))
        return np.array(self._integrator.render(self._scene, sensor=self._sensor, seed=self.seed, spp=spp), np.float32)

    def state(self) -> dict[str, np.ndarray]:
        """Parameters (3,), Adam's moments m, v (3,) and step count t (1,)."""
        return {"parameters": self._parameters.copy(), "m": self._m.copy(), "v": self._v.copy(), "t": np.array([self._t])}

    def load_state(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Goes on from what `state` returned."""
        parameters = np.array(state["parameters"], np.float64)
        if parameters.shape != (3,):
            raise ShadowmapError(f"a pose of shape {parameters.shape}: give rotation (radians), x and y.")
        self._parameters = parameters
        self._m, self._v = (np.array(state[name], np.float64) for name in ("m", "v"))
        self._t = int(np.asarray(state["t"]).reshape(-1)[0])

    def describe(self) -> dict[str, Any]:
        """Settings for the record: integrator, samples, proxy, optimiser."""
        return {
            "integrator": "direct_projective", **asdict(self.setting), "optimizer": "Adam", "step_size": self.step_size,
            "betas": list(self.betas), "seed": self.seed, "proxy": self.proxy.record(),
        }

    def _place(self, pose: Any) -> None:
        self._params["object.vertex_positions"] = apply_pose(self._rest, pose, self.shift_z)
        self._params.update()


CANDIDATES = tuple(ProjectiveSetting(*counts) for counts in (
    # Counts that the stratified sampler takes without rounding. What limits convergence is the noise of the shadow
    # boundaries' derivative (sppi): nearly no sample meets the small light, so the others are not searched alone.
    (1, 1, 1), (1, 1, 4), (1, 1, 16), (1, 1, 64), (2, 2, 2), (2, 2, 8), (2, 2, 36), (4, 4, 4), (4, 4, 16), (4, 4, 64),
    (4, 4, 144), (8, 8, 36), (8, 8, 64), (16, 16, 16), (16, 16, 64), (16, 16, 144), (64, 64, 64), (16, 16, 256),
    (4, 4, 4, "grid"), (4, 4, 4, "octree"), (16, 16, 16, "octree"),
))


def pose_start(run: int, seed: int = 0) -> np.ndarray:
    """(3,) start of a run by the protocol: rotation in radians, x, y."""
    rng = np.random.default_rng(seed + run)
    x, y = rng.uniform(-0.25, 0.25, size=2)
    return np.array([np.radians(rng.uniform(-30, 30)), x, y])


def fair_setting(resolution: int) -> ProjectiveSetting:
    """The stored fair setting at a resolution, or at the nearest one that was searched.

    Raises:
        ShadowmapError: No search is stored.
    """
    found = {int(key): entry for key, entry in _stored().items() if entry["setting"] is not None}
    if not found:
        raise ShadowmapError(f"{STORE} holds no setting: run python -m mitsuba_baselines.pose --search {resolution}.")
    nearest = min(found, key=lambda size: abs(np.log2(size / resolution)))
    return ProjectiveSetting(**found[nearest]["setting"])


def find_fair_setting(
    resolution: int,
    *,
    mesh: str = "spot",
    candidates: tuple[ProjectiveSetting, ...] = CANDIDATES,
    starts: int = 3,
    iterations: int = 150,
    threshold_deg: float = 0.1,
    report: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """Searches the cheapest setting that converges.

    All candidates are timed; then, cheapest first, each runs from the protocol's starts until one start fails. The first
    one whose mean rotation error over the last 20 iterations is at most the threshold on all starts is the fair setting.

    Args:
        resolution, mesh: Of the pose scene; mesh is a name or a file.
        threshold_deg: Degrees.
        report: Called with a line about each measurement.

    Returns:
        A record of JSON values: `setting` (None if no candidate converges), `measurements` with the mean errors in
        degrees, the final offsets and the median seconds per iteration of each candidate, the proxy and the machine.
    """
    scene_path, mesh_path = assets.scene("pose"), assets.mesh(mesh)
    scene = mi.load_file(str(scene_path), optimize=False, object=str(mesh_path), resolution=resolution)
    reference, proxy = path_traced(scene, spp=512).image, calibrate(scene)

    def method(setting: ProjectiveSetting) -> MitsubaPose:
        return MitsubaPose(scene_path, mesh_path, resolution, setting, reference, proxy=proxy)

    cost: dict[ProjectiveSetting, float] = {}
    for setting in candidates:
        pose = method(setting)
        pose.reset(pose_start(0))
        pose.step()
        cost[setting] = float(np.median([_timed(pose.step) for _ in range(3)]))
        report(f"{setting}: {cost[setting]:.2f} s per step")

    measurements, chosen = [], None
    for setting in sorted(candidates, key=cost.__getitem__):
        pose = method(setting)
        runs: list[dict[str, Any]] = []
        for run in range(starts):
            pose.reset(pose_start(run))
            trace, seconds = [], []
            for _ in range(iterations):
                seconds.append(_timed(pose.step))
                trace.append(pose.parameters())
            last = np.degrees(np.abs(np.array(trace)[-20:, 0]))
            runs.append({
                "run": run, "start": pose_start(run).tolist(), "final": trace[-1].tolist(),
                "mean_error_deg_last_20": float(last.mean()), "offset_x100": float(100 * np.hypot(*trace[-1][1:])),
                "seconds_per_iteration": float(np.median(seconds[5:] or seconds)),
            })
            report(f"{setting} run {run}: {last.mean():.3f} degrees, {runs[-1]['offset_x100']:.2f}, "
                   f"{runs[-1]['seconds_per_iteration']:.2f} s per step")
            if not last.mean() <= threshold_deg:
                break
        measurements.append({"setting": asdict(setting), "timed_seconds_per_iteration": cost[setting], "runs": runs})
        if len(runs) == starts and runs[-1]["mean_error_deg_last_20"] <= threshold_deg:
            chosen = setting
            break
    return {
        "setting": asdict(chosen) if chosen else None, "resolution": resolution, "mesh": mesh, "starts": starts,
        "iterations": iterations, "threshold_deg": threshold_deg, "measurements": measurements,
        "untried": {str(each): cost[each] for each in candidates
                    if asdict(each) not in [entry["setting"] for entry in measurements]},
        "proxy": proxy.record(), "mitsuba": mi.__version__, "variant": mi.variant(), "threads": dr.thread_count(),
        "load_average": os.getloadavg()[0],
    }


def _timed(step: Callable[[], Any]) -> float:
    begin = time.perf_counter()
    step()
    dr.sync_thread()
    return time.perf_counter() - begin


def _stored() -> dict[str, Any]:
    return json.loads(STORE.read_text()) if STORE.is_file() else {}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m mitsuba_baselines.pose", description="Searches fair settings.")
    parser.add_argument("--search", type=int, required=True, metavar="RESOLUTION")
    parser.add_argument("--mesh", default="spot", help="name or file")
    parser.add_argument("--output", type=Path, default=STORE, help="JSON file to extend")
    options = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    record = find_fair_setting(options.search, mesh=options.mesh, report=lambda line: print(line, flush=True))
    table = json.loads(options.output.read_text()) if options.output.is_file() else {}
    table[str(options.search)] = record
    temporary = options.output.with_suffix(".tmp")
    temporary.write_text(json.dumps(table, indent=1) + "\n")
    os.replace(temporary, options.output)
    print(f"fair setting at {options.search}: {record['setting']}")


if __name__ == "__main__":
    main()

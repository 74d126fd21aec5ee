"""Pose estimation with Mitsuba's `direct_projective` integrator and an area light in place of the directional one.

`MitsubaPose` has the interface of the other methods of the pose experiment. `find_fair_setting` searches the cheapest
sample counts with which it converges; what it found is stored in `fair_settings.json`, read by `fair_setting` and
extended by ``python -m mitsuba_baselines.pose --search RESOLUTION``.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.inverse.pose import apply_pose
from shadowmap_dr.io import assets
from shadowmap_dr.io.files import atomic

from .proxy import Proxy, calibrate, with_proxy
from .reference import path_traced

STORE = Path(__file__).with_name("fair_settings.json")
MAX_RESOLUTION = 4096
GUIDINGS = ("none", "grid", "octree")


@dataclass(frozen=True, order=True)
class ProjectiveSetting:
    """Samples per pixel of Mitsuba's projective integrators.

    Attributes:
        sppc: For the continuous part of the derivative.
        sppp: For silhouettes as the camera sees them.
        sppi: For silhouettes as the light sees them, which move shadows.
        guiding: "none", "grid" or "octree" (Mitsuba's default, rebuilt at every step).
        spp: For the image in the loss. These samples are far cheaper than those of derivatives, and near the solution the
            noise of the loss is what shakes the pose.
    """

    sppc: int
    sppp: int
    sppi: int
    guiding: str = "none"
    spp: int = 64

    def __post_init__(self) -> None:
        if self.guiding not in GUIDINGS:
            raise ShadowmapError(f"guiding {self.guiding!r}: choose from {', '.join(GUIDINGS)}.")
        if min(self.sppc, self.sppp, self.sppi, self.spp) < 1:
            raise ShadowmapError(f"sample counts {self.sppc}/{self.sppp}/{self.sppi}: each must be at least 1.")

    def __str__(self) -> str:
        return f"{self.sppc}/{self.sppp}/{self.sppi} {self.guiding}, {self.spp}"

    @classmethod
    def parse(cls, text: str) -> ProjectiveSetting:
        """From "sppc/sppp/sppi", optionally with "/guiding" and "/spp". Raises ShadowmapError for anything else."""
        part = text.split("/")
        try:
            return cls(*map(int, part[:3]), *part[3:4], *map(int, part[4:]))
        except ShadowmapError:
            raise
        except (TypeError, ValueError) as error:
            raise ShadowmapError(f"sample counts {text}: give C/P/I, C/P/I/GUIDING or C/P/I/GUIDING/SPP.") from error


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
        proxy: Area light to use; default: calibrated here for this scene and resolution. (With `shift_z`, Mitsuba's directional
            light in that scene knows only the extent that the scene was loaded with, which `image_residual` suffers from:
            give a proxy calibrated with a scene whose mesh file lies where the object is.)
        normals: "face" or "vertex": flat or smooth shading of the object, the scene's parameter `$face_normals`.

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
        normals: str = "face",
    ) -> None:
        image = np.asarray(reference, np.float32)
        if image.ndim != 3 or image.shape[:2] != (resolution, resolution) or not np.isfinite(image).all():
            raise ShadowmapError(
                f"a reference of shape {image.shape}: give finite values of shape ({resolution}, {resolution}, C)."
            )
        self.setting, self.step_size, self.betas, self.seed, self.shift_z = setting, step_size, betas, seed, shift_z
        scene = _load(scene_path, mesh_path, resolution, normals)
        params = mi.traverse(scene)
        self._rest = mi.Float(params["object.vertex_positions"])
        params["object.vertex_positions"] = apply_pose(self._rest, dr.zeros(mi.Float, 3), shift_z)
        params.update()
        self.proxy = calibrate(scene) if proxy is None else proxy
        self._scene = with_proxy(scene, self.proxy)
        self._params = mi.traverse(self._scene)
        self._sensor = self._scene.sensors()[0]
        self._reference = mi.TensorXf(image)
        self._integrator = mi.load_dict(
            {
                "type": "direct_projective",
                "sppc": setting.sppc,
                "sppp": setting.sppp,
                "sppi": setting.sppi,
                "guiding": setting.guiding,
            }
        )
        self.reset((0.0, 0.0, 0.0))

    def reset(self, start: npt.ArrayLike) -> None:
        """Starts anew at (rotation in radians, x, y) with empty moments."""
        self.load_state(
            {"parameters": np.asarray(start, np.float64), "m": np.zeros(3), "v": np.zeros(3), "t": np.zeros(1, np.int64)}
        )

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
            image = self._integrator.render(self._scene, sensor=self._sensor, seed=int(seeds[0]), spp=self.setting.spp)
            difference = dr.detach(image) - self._reference
            count = difference.array.shape[0]
            loss = dr.sum(dr.square(difference.array)) / count
        self._integrator.render_backward(
            self._scene, self._params, difference * (2 / count), sensor=self._sensor, seed=int(seeds[1]), spp=0
        )
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
            "integrator": "direct_projective",
            **asdict(self.setting),
            "optimizer": "Adam",
            "step_size": self.step_size,
            "betas": list(self.betas),
            "seed": self.seed,
            "proxy": self.proxy.record(),
        }

    def _place(self, pose: Any) -> None:
        self._params["object.vertex_positions"] = apply_pose(self._rest, pose, self.shift_z)
        self._params.update()


CANDIDATES = tuple(
    ProjectiveSetting(*counts)
    for counts in (
        # Counts that the stratified sampler takes without rounding. What limits convergence is the noise of the shadow
        # boundaries' derivative (sppi): nearly no sample meets the small light, so the others are not searched alone.
        (1, 1, 1),
        (1, 1, 4),
        (1, 1, 16),
        (1, 1, 64),
        (2, 2, 2),
        (2, 2, 8),
        (2, 2, 36),
        (4, 4, 4),
        (4, 4, 16),
        (4, 4, 64),
        (4, 4, 144),
        (4, 4, 256),
        (8, 8, 36),
        (8, 8, 64),
        (16, 16, 16),
        (16, 16, 64),
        (16, 16, 144),
        (64, 64, 64),
        (16, 16, 256),
        (4, 4, 4, "grid"),
        (4, 4, 4, "octree"),
        (16, 16, 16, "octree"),
    )
)


def pose_start(run: int, seed: int = 0) -> np.ndarray:
    """(3,) start of a run by the protocol: rotation in radians, x, y."""
    rng = np.random.default_rng(seed + run)
    x, y = rng.uniform(-0.25, 0.25, size=2)
    return np.array([np.radians(rng.uniform(-30, 30)), x, y])


def fair_setting(resolution: int, normals: str = "face") -> ProjectiveSetting:
    """The stored fair setting at a resolution, with normals "face" or "vertex"; where none was found, the one at
    the nearest resolution, with as many samples for the whole image.

    Such a stand-in (`is_fair` tells) is on the cheap side: a proxy light has a size in pixels, and the smaller it is, the more
    samples miss it.

    Raises:
        ShadowmapError: No search is stored that found a setting.
    """
    found, setting = _nearest(resolution, normals)
    if found == resolution:
        return setting
    scale = (found / resolution) ** 2
    counts = {name: max(1, round(getattr(setting, name) * scale)) for name in ("sppc", "sppp", "sppi", "spp")}
    return replace(setting, **counts)


def is_fair(setting: ProjectiveSetting, resolution: int, normals: str = "face", mesh: str = "spot") -> bool:
    """True if a stored search with this very mesh and resolution found the setting to be the cheapest one that converges."""
    return any(
        entry["setting"] == asdict(setting)
        and entry["resolution"] == resolution
        and entry.get("mesh", "spot") == mesh
        and entry.get("normals", "face") == normals
        for entry in _stored().values()
    )


def is_searched(normals: str = "face") -> bool:
    """Whether a stored search has found a setting with normals "face" or "vertex", at any resolution."""
    return any(entry["setting"] and entry.get("normals", "face") == normals for entry in _stored().values())


def find_fair_setting(
    resolution: int,
    *,
    mesh: str = "spot",
    normals: str = "face",
    candidates: tuple[ProjectiveSetting, ...] = CANDIDATES,
    starts: int = 3,
    iterations: int = 150,
    threshold_deg: float = 0.1,
    earlier: Mapping[str, Any] | None = None,
    report: Callable[[str], None] = lambda line: None,
    save: Callable[[dict[str, Any]], None] = lambda record: None,
) -> dict[str, Any]:
    """Searches the cheapest setting that converges.

    All candidates are timed; then, cheapest first, each runs from the protocol's starts until one start fails. The first
    one whose mean rotation error over the last 20 iterations is at most the threshold on all starts is the fair setting.
    Where an earlier search has found one, it is timed beside the candidates, and what costs more is not tried.

    Args:
        resolution, mesh, normals: Of the pose scene; mesh is a name or a file, normals "face" or "vertex".
        threshold_deg: Degrees.
        earlier: Record of a search that was cut short: what it measured is not measured again.
        report: Called with a line about each measurement.
        save: Called with the record so far after each run and each candidate.

    Raises ShadowmapError if the earlier search was one of something else.

    Returns:
        A record of JSON values: `setting` (None if no candidate converged), `measurements` with the mean errors in
        degrees, the final offsets and the median seconds per iteration of each candidate, the seconds per iteration of
        those not tried, the proxy and the machine.
    """
    protocol = {
        "resolution": resolution,
        "mesh": mesh,
        "normals": normals,
        "starts": starts,
        "iterations": iterations,
        "threshold_deg": threshold_deg,
    }
    earlier = earlier or protocol
    for name, value in protocol.items():
        # Searches from before there was a choice are with flat shading.
        found = earlier.get(name, "face" if name == "normals" else value)
        if found != value:
            raise ShadowmapError(f"the earlier search had {name} {found}, not {value}: choose another file for this one.")
    scene_path, mesh_path = assets.scene("pose"), assets.mesh(mesh)
    scene = _load(scene_path, mesh_path, resolution, normals)
    reference, proxy = path_traced(scene, spp=512).image, calibrate(scene)
    record: dict[str, Any] = {
        **protocol,
        "measurements": list(earlier.get("measurements", [])),
        "untried": dict(earlier.get("untried", {})),
        "proxy": proxy.record(),
        "mitsuba": mi.__version__,
        "variant": mi.variant(),
        "threads": dr.thread_count(),
    }
    record["setting"] = _cheapest(record["measurements"], starts, threshold_deg)
    begun = [entry for entry in record["measurements"] if not _complete(entry, starts, threshold_deg)]
    measured = [entry["setting"] for entry in record["measurements"] if entry not in begun]
    candidates = tuple(setting for setting in candidates if asdict(setting) not in measured)

    def method(setting: ProjectiveSetting) -> MitsubaPose:
        return MitsubaPose(scene_path, mesh_path, resolution, setting, reference, proxy=proxy, normals=normals)

    def step_cost(setting: ProjectiveSetting) -> float:
        pose = method(setting)
        pose.reset(pose_start(0))
        pose.step()
        seconds = float(np.median([_timed(pose.step) for _ in range(3)]))
        report(f"{setting}: {seconds:.2f} s per step")
        return seconds

    cost = {}
    for setting in candidates:
        cost[setting] = record["untried"][str(setting)] = step_cost(setting)
        save(record)
    limit = step_cost(ProjectiveSetting(**record["setting"])) if record["setting"] and candidates else float("inf")

    for setting in sorted(candidates, key=cost.__getitem__):
        if cost[setting] >= limit:
            break
        pose = method(setting)
        entry = next((entry for entry in begun if entry["setting"] == asdict(setting)), None)
        if entry is None:
            entry = {
                "setting": asdict(setting),
                "timed_seconds_per_iteration": cost[setting],
                "load_average": os.getloadavg()[0],
                "runs": [],
            }
            record["measurements"].append(entry)
        runs = entry["runs"]
        while not _complete(entry, starts, threshold_deg):
            runs.append(_measure(pose, len(runs), iterations))
            report(
                "{} run {run}: {mean_error_deg_last_20:.3f} degrees, {offset_x100:.2f}, "
                "{seconds_per_iteration:.2f} s per step".format(setting, **runs[-1])
            )
            save(record)
        del record["untried"][str(setting)]
        record["setting"] = _cheapest(record["measurements"], starts, threshold_deg)
        save(record)
        if _cheapest([entry], starts, threshold_deg):
            break
    return record


def _complete(entry: Mapping[str, Any], starts: int, threshold_deg: float) -> bool:
    """Whether a candidate has run from all starts, or lost one, so that no more need be known."""
    runs = entry["runs"]
    return len(runs) >= starts or any(not run["mean_error_deg_last_20"] <= threshold_deg for run in runs)


def _cheapest(measurements: list[dict[str, Any]], starts: int, threshold_deg: float) -> dict[str, Any] | None:
    """The setting with the fastest steps among those that converged from all starts; None if none did."""
    passed = [
        entry
        for entry in measurements
        if len(entry["runs"]) == starts and all(run["mean_error_deg_last_20"] <= threshold_deg for run in entry["runs"])
    ]
    cost = lambda entry: float(np.median([run["seconds_per_iteration"] for run in entry["runs"]]))  # noqa: E731
    return min(passed, key=cost)["setting"] if passed else None


def _measure(pose: MitsubaPose, run: int, iterations: int) -> dict[str, Any]:
    """One run from a start of the protocol."""
    pose.reset(pose_start(run))
    trace, seconds = [], []
    for _ in range(iterations):
        seconds.append(_timed(pose.step))
        trace.append(pose.parameters())
    return {
        "run": run,
        "start": pose_start(run).tolist(),
        "final": trace[-1].tolist(),
        "mean_error_deg_last_20": float(np.degrees(np.abs(np.array(trace)[-20:, 0])).mean()),
        "offset_x100": float(100 * np.hypot(*trace[-1][1:])),
        "seconds_per_iteration": float(np.median(seconds[5:] or seconds)),
    }


def _timed(step: Callable[[], Any]) -> float:
    begin = time.perf_counter()
    step()
    dr.sync_thread()
    return time.perf_counter() - begin


def _load(scene_path: str | Path, mesh_path: str | Path, resolution: int, normals: str) -> Any:
    flat = "true" if normals == "face" else "false"
    try:
        return mi.load_file(str(scene_path), optimize=False, object=str(mesh_path), resolution=resolution, face_normals=flat)
    except RuntimeError as error:
        raise ShadowmapError(f"cannot load {scene_path} with {mesh_path}: {' '.join(str(error).split())}") from error


def _stored(path: Path | None = None) -> dict[str, dict[str, Any]]:
    """Searches by name, those of this package if no file is given."""
    path = path or STORE
    table = json.loads(path.read_text()) if path.is_file() else {}
    if not isinstance(table, dict) or not all(isinstance(entry, dict) for entry in table.values()):
        raise ShadowmapError(f"{path} holds no searches: choose another file.")
    return table


def _nearest(resolution: int, normals: str) -> tuple[int, ProjectiveSetting]:
    """The resolution nearest to the given one at which a stored search found a setting, and the setting."""
    found = {
        entry["resolution"]: ProjectiveSetting(**entry["setting"])
        for entry in _stored().values()
        if entry["setting"] and entry.get("normals", "face") == normals
    }
    if not found:
        raise ShadowmapError(
            f"no setting is known to converge with {normals} normals: "
            f"run python -m mitsuba_baselines.pose --search {resolution} --normals {normals}."
        )
    nearest = min(found, key=lambda size: abs(np.log2(size / resolution)))
    return nearest, found[nearest]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m mitsuba_baselines.pose", description="Searches fair settings.")
    parser.add_argument("--search", type=int, required=True, metavar="RESOLUTION")
    parser.add_argument("--mesh", default="spot", help="name or file")
    parser.add_argument("--normals", choices=("face", "vertex"), default="face", help="flat or smooth shading of the object")
    parser.add_argument("--candidates", nargs="+", metavar="C/P/I[/GUIDING[/SPP]]", help="settings to try instead of the usual")
    parser.add_argument("--output", type=Path, default=STORE, help="JSON file to extend; a search in it goes on")
    try:
        _search(parser.parse_args())
    except (ShadowmapError, OSError, json.JSONDecodeError) as error:
        sys.exit(f"error: {' '.join(str(error).split())}")


def _search(options: argparse.Namespace) -> None:
    candidates = CANDIDATES
    if options.candidates:
        candidates = tuple(dict.fromkeys(ProjectiveSetting.parse(text) for text in options.candidates))
    if not 1 <= options.search <= MAX_RESOLUTION:
        raise ShadowmapError(f"a resolution of {options.search} pixels: give 1 to {MAX_RESOLUTION}.")
    mi.set_variant("llvm_ad_rgb")
    key = str(options.search) if options.normals == "face" else f"{options.search} {options.normals} normals"

    def save(record: dict[str, Any]) -> None:
        # Read again each time: another search may have written its own record meanwhile.
        table = {**_stored(options.output), key: record}
        with atomic(options.output) as temporary:
            temporary.write_text(json.dumps(table, indent=1) + "\n")

    record = find_fair_setting(
        options.search,
        mesh=options.mesh,
        normals=options.normals,
        candidates=candidates,
        earlier=_stored(options.output).get(key),
        save=save,
        report=lambda line: print(line, flush=True),
    )
    print(f"fair setting at {key}: {record['setting']}")


if __name__ == "__main__":
    main()

"""Pose estimation with Mitsuba's `direct_projective` integrator and an area light in place of the directional one.

`MitsubaPose` has the interface of the other methods of the pose experiment. Sample counts for it are in
:mod:`mitsuba_baselines.fair_settings`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from shadowmap_dr.errors import ShadowmapError, did_you_mean
from shadowmap_dr.inverse.pose import apply_pose
from shadowmap_dr.jit.arrays import device_array, device_tensor
from shadowmap_dr.scene.mitsuba_meshes import positions_in, set_positions

from .proxy import Proxy, calibrate, with_proxy

GUIDINGS = ("none", "grid", "octree")


@dataclass(frozen=True, order=True)
class ProjectiveSetting:
    """Samples per pixel of Mitsuba's projective integrators.

    Attributes:
        sppc: For the continuous part of the derivative.
        sppp: For silhouettes seen from the camera.
        sppi: For silhouettes seen from the light, which move shadows.
        guiding: "none", "grid" or "octree" (Mitsuba's default, rebuilt at every step).
        spp: For the image in the loss. These samples are far cheaper than samples of derivatives, and near the solution the
            noise of the loss disturbs the pose most.
    """

    sppc: int
    sppp: int
    sppi: int
    guiding: str = "none"
    spp: int = 64

    def __post_init__(self) -> None:
        if self.guiding not in GUIDINGS:
            raise ShadowmapError(
                f"guiding {self.guiding!r}: choose from {', '.join(GUIDINGS)}.{did_you_mean(self.guiding, GUIDINGS)}"
            )
        if min(self.sppc, self.sppp, self.sppi, self.spp) < 1:
            raise ShadowmapError(f"sample counts {self.sppc}/{self.sppp}/{self.sppi}: each must be at least 1.")

    def __str__(self) -> str:
        return f"{self.sppc}/{self.sppp}/{self.sppi} {self.guiding}, {self.spp}"

    @classmethod
    def parse(cls, text: str) -> ProjectiveSetting:
        """Parse "sppc/sppp/sppi", optionally with "/guiding" and "/spp". Raises ShadowmapError for other texts."""
        part = text.split("/")
        try:
            counts: list[Any] = [*map(int, part[:3]), *part[3:4], *map(int, part[4:])]
            return cls(*counts)
        except ShadowmapError:
            raise
        except (TypeError, ValueError) as error:
            raise ShadowmapError(f"sample counts {text}: give C/P/I, C/P/I/GUIDING or C/P/I/GUIDING/SPP.") from error


class MitsubaPose:
    """Fit of a mesh's pose to a reference image with Mitsuba's projective integrator and Adam.

    Args:
        scene_path: XML scene with the parameters `$object` and `$resolution` and the ids `object`, `wall`, `light` (a
            directional light) and `camera`, such as `scenes/pose.xml`.
        mesh_path: Mesh file of the object.
        resolution: Width and height of the image.
        setting: Sample counts and guiding.
        reference: (H, W, C) linear image to fit.
        step_size, betas: Of Adam.
        seed: Of the sampling; each step derives its own seeds.
        shift_z: Constant offset in z on top of the pose.
        proxy: Area light to use; default: calibrated here for this scene and resolution. (With `shift_z`, Mitsuba's directional
            light knows only the extent of the scene as it was loaded, and `image_residual` is wrong: give a proxy calibrated
            with a scene whose mesh file already contains the shift.)
        normals: "face" or "vertex": flat or smooth shading of the object, the scene's parameter `$face_normals`.

    Raises:
        ShadowmapError: The reference has another shape or is not finite, or `proxy.calibrate` fails.
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
        scene = load_scene(scene_path, mesh_path, resolution, normals)
        params = mi.traverse(scene)
        self._rest = positions_in(params, "object")
        set_positions(params, apply_pose(self._rest, dr.zeros(mi.Float, 3), shift_z), "object")
        params.update()
        self.proxy = calibrate(scene) if proxy is None else proxy
        self._scene = with_proxy(scene, self.proxy)
        self._params = mi.traverse(self._scene)
        self._sensor = self._scene.sensors()[0]
        self._reference = device_tensor(mi.TensorXf, image)
        self._integrator = mi.load_dict(
            {
                "type": "direct_projective",
                "sppc": setting.sppc,
                "sppp": setting.sppp,
                "sppi": setting.sppi,
                "guiding": setting.guiding,
            }
        )
        self._parameters: npt.NDArray[np.float64]
        self._m: npt.NDArray[np.float64]
        self._v: npt.NDArray[np.float64]
        self._t: int
        self.reset((0.0, 0.0, 0.0))

    def reset(self, start: npt.ArrayLike) -> None:
        """Restart at (rotation in radians, x, y) with empty moments."""
        self.load_state(
            {"parameters": np.asarray(start, np.float64), "m": np.zeros(3), "v": np.zeros(3), "t": np.zeros(1, np.int64)}
        )

    def step(self) -> float:
        """Take one step of Adam. Returns the loss before the step: the mean squared difference of linear colours."""
        loss, gradient = self.loss_and_gradient(self._parameters)
        beta1, beta2 = self.betas
        self._t += 1
        self._m = beta1 * self._m + (1 - beta1) * gradient
        self._v = beta2 * self._v + (1 - beta2) * gradient**2
        mean, variance = self._m / (1 - beta1**self._t), self._v / (1 - beta2**self._t)
        self._parameters = self._parameters - self.step_size * mean / (np.sqrt(variance) + 1e-8)
        return loss

    def loss_and_gradient(self, parameters: npt.ArrayLike) -> tuple[float, np.ndarray]:
        """Loss and its estimated gradient (3,) at a pose. The state stays as it is, except for the mesh in the scene.

        The image in the loss and the derivative use different random numbers: otherwise the gradient would be biased.
        """
        pose = device_array(mi.Float, parameters)
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
        """Current parameters (3,): rotation in radians, x, y."""
        return self._parameters.copy()

    def render(self, parameters: npt.ArrayLike, spp: int = 64) -> np.ndarray:
        """(H, W, C) float32 linear image at a pose, lit by the proxy."""
        self._place(device_array(mi.Float, parameters))
        return np.array(self._integrator.render(self._scene, sensor=self._sensor, seed=self.seed, spp=spp), np.float32)

    def state(self) -> dict[str, np.ndarray]:
        """Parameters (3,), Adam's moments m, v (3,) and step count t (1,)."""
        return {"parameters": self._parameters.copy(), "m": self._m.copy(), "v": self._v.copy(), "t": np.array([self._t])}

    def load_state(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Continue from a result of `state`. Raises ShadowmapError if it does not hold three parameters."""
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

    def _place(self, pose: mi.Float) -> None:
        """Move the mesh in the scene."""
        set_positions(self._params, apply_pose(self._rest, pose, self.shift_z), "object")
        self._params.update()


def pose_start(run: int, seed: int = 0) -> np.ndarray:
    """Start (3,) of a run by the protocol: rotation in radians, x, y."""
    rng = np.random.default_rng(seed + run)
    x, y = rng.uniform(-0.25, 0.25, size=2)
    return np.array([np.radians(rng.uniform(-30, 30)), x, y])


def load_scene(scene_path: str | Path, mesh_path: str | Path, resolution: int, normals: str) -> mi.Scene:
    """Load a scene with an object, normals "face" or "vertex". Raises ShadowmapError if it cannot be loaded."""
    flat = "true" if normals == "face" else "false"
    try:
        return mi.load_file(str(scene_path), optimize=False, object=str(mesh_path), resolution=resolution, face_normals=flat)
    except RuntimeError as error:
        raise ShadowmapError(f"cannot load {scene_path} with {mesh_path}: {' '.join(str(error).split())}") from error

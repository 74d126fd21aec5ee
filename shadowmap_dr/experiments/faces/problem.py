"""Set-up of the experiment on faces: a head in profile before a wall, one or three lights, artificial heads, references."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...inverse.faces.morph_fit import MorphFit
from ...inverse.faces.morphable import MorphableModel, load_model
from ...io import assets
from ...jit.arrays import device_array
from ...rendering.receivers.planar_receiver import ReceiverShadows, Window
from ...scene.mitsuba_meshes import make_mesh
from ...shadow import ShadowSettings

Mode = Literal["identity", "both", "expression"]
FloatArray = npt.NDArray[np.float32]

#: Weights to be found: identity; identity and expression; expression of a head whose identity is known.
MODES: tuple[Mode, ...] = ("identity", "both", "expression")
#: Numbers of lights, and the angle between two of them.
LIGHTS = (1, 3)
ANGLE_DEG = 15.0
RECEIVER_Z = -2.0
#: Depth before the receiver in which a head may lie, and half the side of the cube that a model must fit into.
_REACH, _CUBE = 6.0, 1.25
# Space around the shadow of the mean head: beside and above it, and below the place where the neck begins.
_BESIDE, _ABOVE, _BELOW = 0.35, 0.25, 0.1


@dataclass(frozen=True)
class FaceScene:
    """Scene and settings that are the same for all heads.

    Attributes:
        model: faces +x, within [-1, 1]^3.
        lights: number of lights: 1 (along -z) or 3 (two more, turned about the vertical by +-15 degrees).
        window: the part of the receiver that the image shows. It ends above the torso.
        shadows: renders the images.
    """

    model: MorphableModel
    lights: int
    window: Window
    shadows: ReceiverShadows

    @classmethod
    def build(
        cls, model: MorphableModel, lights: int, height: int = 192, map_resolution: int = 256, filter_size: int = 3
    ) -> FaceScene:
        """Set up for a model.

        Args:
            lights: 1 or 3.
            height: rows of the image.
            map_resolution, filter_size: of the shadow maps (Gaussian), in texels.

        Raises ShadowmapError for invalid settings, or for a model that is not scaled into the unit cube.
        """
        if lights not in LIGHTS:
            raise ShadowmapError(f"{lights} shadows: choose {' or '.join(map(str, LIGHTS))}.")
        if not 16 <= height <= 2048:
            raise ShadowmapError(f"an image of {height} rows: give 16 to 2048.")
        head = model.mean[model.mask]
        if not 0.25 <= np.abs(head).max() <= _CUBE:
            raise ShadowmapError(
                f"a head that reaches {np.abs(head).max():.3g} from the origin: scale the model into [-1, 1]^3 "
                "(`shadowmap-dr face convert` does)."
            )
        try:
            settings = ShadowSettings(method="vsm", resolution=map_resolution, filter="gaussian", filter_size=filter_size)
        except ValueError as error:
            raise ShadowmapError(str(error)) from None
        window, directions = make_window(head, lights), light_directions(lights)
        shadows = ReceiverShadows.build(model.faces, model.mean, directions, window, height, settings, _REACH)
        return cls(model, lights, window, shadows)

    def shadow(self, vertices: npt.ArrayLike) -> FloatArray:
        """(H, W) visibility behind a head with the given (V, 3) vertices, rendered with this library. No gradients."""
        with dr.suspend_grad():
            image = self.shadows.render(device_array(mi.Float, vertices))
            return np.array(image).reshape(self.shadows.shape)

    def fit(
        self,
        mode: Mode,
        reference: npt.ArrayLike,
        *,
        identity: npt.ArrayLike = (),
        **options: Any,  # Any: keyword arguments of `MorphFit`, of different types
    ) -> MorphFit:
        """The fit of a mode to a reference (H, W); ``identity``: the known weights in mode ``expression``."""
        known = identity if mode == "expression" else ()
        if mode != "identity" and not len(self.model.expression):
            raise ShadowmapError(f"mode {mode}: this model has no expressions, choose identity.")
        return MorphFit(self.shadows, self.model.vertices(known), self.model.basis(mode), reference, **options)


def default_model(path: str | Path | None = None) -> MorphableModel:
    """The head of this package, or a model from a file."""
    return load_model(assets.scenes_dir() / "heads" / "head.npz" if path is None else path)


def light_directions(lights: int) -> list[tuple[float, float, float]]:
    """Unit vectors along which light travels."""
    angles = np.radians([0.0, ANGLE_DEG, -ANGLE_DEG][:lights])
    return [(float(np.sin(a)), 0.0, float(-np.cos(a))) for a in angles]


def make_window(head: npt.ArrayLike, lights: int) -> Window:
    """The rectangle around the shadows of a mean head with a margin. ``head``: its (N, 3) vertices above the neck."""
    low, high = np.min(head, axis=0), np.max(head, axis=0)
    aside = np.tan(np.radians(ANGLE_DEG)) * abs(RECEIVER_Z) if lights > 1 else 0.0
    first = (float(low[0] - _BESIDE - aside), float(low[1] - _BELOW))
    return Window(first, (float(high[0] + _BESIDE + aside), float(high[1] + _ABOVE)), RECEIVER_Z)


def artificial_weights(model: MorphableModel, seed: int, mode: Mode) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """(identity (K,), expression (E,)) weights of an artificial head: standard normal, from the seed only.

    Expressions are the same in both modes that have them, and zero in mode ``identity``. They are positive, since shapes of
    expressions are poses of muscles, which pull in one direction only.
    """
    if seed < 0:
        raise ShadowmapError(f"a head of seed {seed}: give 0 or more.")
    identity = np.random.default_rng(seed).standard_normal(len(model.identity))
    if mode == "identity":
        return identity, np.zeros(len(model.expression))
    return identity, np.abs(np.random.default_rng([seed, 1]).standard_normal(len(model.expression)))


def path_traced_shadow(scene: FaceScene, vertices: npt.ArrayLike, spp: int) -> FloatArray:
    """(H, W) visibility behind a head as Mitsuba's path tracer sees it with a camera between head and receiver."""
    from mitsuba_baselines.reference import path_traced

    height, width = scene.shadows.shape
    window, transform = scene.window, mi.ScalarTransform4f
    center = [0.5 * (a + b) for a, b in zip(window.low, window.high, strict=True)]
    # Between receiver and head.
    eye = [*center, window.z + 0.02]
    mesh = make_mesh("head", vertices, scene.model.faces)
    description: dict[str, Any] = {
        "type": "scene",
        "camera": {
            "type": "orthographic",
            "to_world": transform().look_at(eye, [*center, window.z], [0, 1, 0])
            @ transform().scale([0.5 * window.size[0]] * 2 + [1]),
            "near_clip": 1e-3,
            "far_clip": 1.0,
            "film": {
                "type": "hdrfilm",
                "width": width,
                "height": height,
                "rfilter": {"type": "box"},
                "pixel_format": "luminance",
                "component_format": "float32",
            },
            "sampler": {"type": "multijitter", "sample_count": 64},
        },
        "receiver": {
            "type": "rectangle",
            "to_world": transform().translate([*center, window.z]) @ transform().scale(2 * max(window.size)),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}},
        },
        "head": mesh,
    }
    directions = light_directions(scene.lights)
    for k, direction in enumerate(directions):
        irradiance = np.pi / len(directions) / -direction[2]  # equal light on the receiver from each of them
        description[f"light{k}"] = {
            "type": "directional",
            "direction": list(direction),
            "irradiance": {"type": "rgb", "value": float(irradiance)},
        }
    return path_traced(mi.load_dict(description, optimize=False), spp=spp).image[..., 0]

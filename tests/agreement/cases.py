"""One-bounce scenes on which Mitsuba tests the derivatives of its own integrators, built anew from what they show.

Each has one number t, at rest 0, that changes a parameter of the scene.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .shapes import ball, camera, gray, lamp, rough_picture, square

Change = Callable[[Any, Any], Any]

#: Options of the plug-in: shadow maps as by default, but more points on lamps and directions of skies.
OPTIONS = {"area_light_samples": 128, "environment_light_samples": 256}


@dataclass(frozen=True)
class Case:
    """A scene and what changes in it.

    Attributes:
        name: identifies the case.
        parts: make the scene's dictionary without its camera.
        keys: of ``mi.traverse(scene)`` that change.
        change: value of such a parameter for a number t (Float), from its value at rest.
        step: distance in t of the two images of a central difference.
        film: what the camera's film has instead of its defaults.
        spp: samples per pixel of the plug-in.
        seeds: renderings of Mitsuba's that are averaged for the reference.
        options: of the plug-in, instead of those in ``OPTIONS``.
    """

    name: str
    parts: Callable[[], dict[str, Any]]
    keys: tuple[str, ...]
    change: Change
    step: float
    film: Mapping[str, Any] | None = None
    spp: int = 16
    seeds: int = 2
    options: Mapping[str, Any] | None = None

    def __hash__(self) -> int:
        return hash(self.name)

    def build(self) -> Any:
        """A new ``mi.Scene``, at rest."""
        return mi.load_dict({"type": "scene", "camera": camera(**(self.film or {})), **self.parts()}, optimize=False)


class Changing:
    """A scene of a case, and its number."""

    def __init__(self, case: Case) -> None:
        self.scene = case.build()
        self.params = mi.traverse(self.scene)
        self._change = case.change
        self._rest = {key: type(self.params[key])(self.params[key]) for key in case.keys}

    def set(self, t: Any) -> None:
        """Change the scene. ``t``: Float, may be attached."""
        for key, value in self._rest.items():
            self.params[key] = self._change(type(value)(value), t)
        self.params.update()
        dr.eval()


def _brighter(value: Any, t: Any) -> Any:
    return value + t


def _moved(value: Any, t: Any) -> Any:
    """Vertices, along x."""
    return dr.ravel(dr.unravel(mi.Vector3f, value) + mi.Vector3f(t, 0, 0))


def _grown(value: Any, t: Any) -> Any:
    return value * (1 + t)


def _turned(value: Any, t: Any) -> Any:
    """Normals, about y, by an angle in degrees."""
    angle = t * (np.pi / 180)
    n = dr.unravel(mi.Vector3f, value)
    s, c = dr.sin(angle), dr.cos(angle)
    return dr.ravel(mi.Vector3f(c * n.x + s * n.z, n.y, c * n.z - s * n.x))


def _placed(value: Any, t: Any) -> Any:
    """A transformation, along its own x."""
    return mi.Transform4f(value) @ mi.Transform4f().translate(mi.Vector3f(t, 0, 0))


def _at(x: float, y: float, z: float, scale: float = 1.0) -> Any:
    return mi.ScalarTransform4f().translate([x, y, z]) @ mi.ScalarTransform4f().scale(scale)


def _beside() -> Any:
    """Right of the scene and out of view, facing left."""
    return mi.ScalarTransform4f().translate([1.25, 0, 1]) @ mi.ScalarTransform4f().rotate([0, 1, 0], -90)


def _plane(reflectance: float = 0.5, **more: Any) -> dict[str, Any]:
    return {"type": "rectangle", "bsdf": gray(reflectance), **more}


def _small_sphere() -> dict[str, Any]:
    return {"type": "sphere", "radius": 0.25, "bsdf": gray(0.5)}


def _constant(radiance: float = 1.0) -> dict[str, Any]:
    return {"type": "constant", "radiance": {"type": "rgb", "value": radiance}}


def _sky() -> dict[str, Any]:
    """An environment map, smooth and coloured."""
    rows = 16
    theta = (np.arange(rows) + 0.5)[:, None] / rows * np.pi
    phi = (np.arange(2 * rows) + 0.5)[None] / rows * np.pi
    value = 0.6 + 0.4 * np.sin(phi) * np.sin(theta) + 0.3 * np.cos(theta)
    return {"type": "envmap", "bitmap": mi.Bitmap((value[..., None] * [1.0, 0.8, 0.6]).astype(np.float32))}


def _far_bulb(radius: float = 0.05) -> Any:
    return ball("light", _at(4, 0, 4, radius), rows=8, emitter=lamp(5000.0))


def _hung_ball() -> Any:
    """Out of the camera's view, between lamp and plane."""
    return ball("occluder", _at(2, 0, 2, 0.25))


def _corner() -> dict[str, Any]:
    upright = mi.ScalarTransform4f().translate([-1, 0, 0.5]) @ mi.ScalarTransform4f().rotate([0, 1, 0], 90)
    return {
        "plane": square("plane"),
        "occluder": square("occluder", upright),
        "light": {"type": "point", "position": [-4, 0, 6], "intensity": {"type": "rgb", "value": [5.0, 0.0, 0.0]}},
        "sky": _constant(0.1),
    }


_VERTICES = "vertex_positions"
# Where a sky is constant and nothing lies in its way, or nothing is lit, few samples give the same image in less time.
_FEW = {"area_light_samples": 4, "environment_light_samples": 32}

CASES = (
    Case("albedo", lambda: {"plane": _plane(), "ball": _small_sphere(), "light": _constant()},
         ("plane.bsdf.reflectance.value",), _brighter, 0.1),
    Case("lamp_radiance", lambda: {"plane": _plane(1.0), "ball": _small_sphere(),
                                   "light": {"type": "rectangle", "to_world": _beside(), "emitter": lamp(3.0)}},
         ("light.emitter.radiance.value",), _brighter, 0.5),
    Case("seen_lamp_radiance", lambda: {"light": {"type": "rectangle", "emitter": lamp(1.0)}},
         ("light.emitter.radiance.value",), _brighter, 0.5, options=_FEW),
    Case("point_intensity", lambda: {"plane": _plane(1.0), "ball": _small_sphere(), "light": {
        "type": "point", "position": [1.25, 0, 1], "intensity": {"type": "rgb", "value": 5.0}}},
         ("light.intensity.value",), _brighter, 0.5),
    Case("constant_radiance", lambda: {"plane": _plane(), "ball": _small_sphere(), "light": _constant()},
         ("light.radiance.value",), _brighter, 0.5),
    Case("sky_scale", lambda: {"plane": _plane(), "ball": _small_sphere(), "light": _sky()}, ("light.scale",), _brighter, 0.5),
    Case("crop_window", lambda: {"plane": _plane(), "light": _constant()}, ("plane.bsdf.reflectance.value",), _brighter, 0.1,
         {"crop_width": 32, "crop_height": 32, "crop_offset_x": 32, "crop_offset_y": 20}),
    Case("turned_normals", lambda: {"plane": square("plane", smooth=True),
                                    "light": {"type": "rectangle", "to_world": _beside(), "emitter": lamp(3.0)}},
         ("plane.vertex_normals",), _turned, 0.2),
    Case("ball_in_constant", lambda: {"ball": ball("ball"), "light": _constant()}, ("ball." + _VERTICES,), _moved, 0.01),
    Case("square_in_constant", lambda: {"plane": square("plane"), "light": _constant()}, ("plane." + _VERTICES,), _moved, 0.01),
    Case("lamp_square_moves", lambda: {"light": square("light", _at(1.25, 0, 0), emitter=lamp(1.0))},
         ("light." + _VERTICES,), _moved, 0.01, options=_FEW),
    Case("lamp_ball_moves", lambda: {"light": ball("light", _at(1.25, 0, 0), rows=48, emitter=lamp(1.0))},
         ("light." + _VERTICES,), _moved, 0.01, options=_FEW),
    Case("lamp_ball_grows", lambda: {"light": ball("light", rows=48, emitter=lamp(1.0))}, ("light." + _VERTICES,), _grown, 0.01,
         options=_FEW),
    Case("painted_lamp_moves", lambda: {"light": square("light", _at(0.6, 0, 0), emitter={
        "type": "area", "radiance": rough_picture(16)})}, ("light." + _VERTICES,), _moved, 0.01, spp=256, options=_FEW),
    Case("painted_plane_moves", lambda: {"plane": square("plane", _at(0, 0, 0, 2), bsdf={
        "type": "diffuse", "reflectance": rough_picture(32)}), "light": _constant()},
         ("plane." + _VERTICES,), _moved, 0.002, spp=256, options=_FEW),
    Case("occluder_moves", lambda: {"plane": _plane(), "occluder": _hung_ball(), "light": _far_bulb()},
         ("occluder." + _VERTICES,), _moved, 0.02, seeds=6),
    Case("occluder_of_point", lambda: {"plane": _plane(), "occluder": _hung_ball(), "light": {
        "type": "point", "position": [4, 0, 4], "intensity": {"type": "rgb", "value": 30.0}}},
         ("occluder." + _VERTICES,), _moved, 0.01),
    Case("receiver_moves", lambda: {"plane": square("plane"), "occluder": _hung_ball(), "light": _far_bulb()},
         ("plane." + _VERTICES,), _moved, 0.01),
    Case("receiver_in_constant", lambda: {"plane": square("plane"), "occluder": _hung_ball(), "light": _constant()},
         ("plane." + _VERTICES,), _moved, 0.01),
    Case("corner_moves", _corner, ("plane." + _VERTICES, "occluder." + _VERTICES), _moved, 0.01),
    Case("occluder_in_sky", lambda: {"plane": _plane(), "occluder": ball("occluder", _at(0.2, 0.1, 0.8, 0.5), bsdf=gray(0.1)),
                                     "light": _sky()},
         ("occluder." + _VERTICES,), _moved, 0.02, seeds=4),
    Case("camera_moves", lambda: {"ball": ball("ball"), "light": _constant()}, ("camera.to_world",), _placed, 0.01),
)  # fmt: skip

BY_NAME = {case.name: case for case in CASES}

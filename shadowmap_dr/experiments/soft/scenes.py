"""Scenes under extended lights: area lights of all shapes, skies, rooms, and all kinds of lights at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...io import assets

Parts = dict[str, Any]
# Half-sides, one for all axes or one for each.
Size: TypeAlias = "float | list[float]"


@dataclass(frozen=True)
class SoftScene:
    """A scene without its camera's film.

    Attributes:
        parts: function that makes its shapes and emitters.
        about: its lights and materials, in a few words.
        camera: (origin, target).
        fov: field of view in degrees.
        glossy: it has materials of a roughness below 0.3, which need not meet the error bound.
    """

    parts: Callable[[], Parts]
    about: str
    camera: tuple[tuple[float, float, float], tuple[float, float, float]] = ((0.0, 3.0, 5.5), (0.0, 0.45, 0.0))
    fov: float = 38.0
    glossy: bool = False


def build(name: str, resolution: int) -> mi.Scene:
    """Make a scene of :data:`SCENES`, with a perspective camera, a square film and a box filter."""
    scene = SCENES[name]
    origin, target = scene.camera
    camera = {
        "type": "perspective",
        "fov": scene.fov,
        "to_world": _t().look_at(list(origin), list(target), [0, 1, 0]),
        "film": {
            "type": "hdrfilm",
            "width": resolution,
            "height": resolution,
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
            "component_format": "float32",
            "sample_border": True,
        },
    }
    return mi.load_dict({"type": "scene", "camera": camera, **scene.parts()}, optimize=False)


def _t() -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f()


# -------------------------------------------------------------------------------------------------------------- materials


def _rgb(*value: float) -> Parts:
    return {"type": "rgb", "value": list(value) if len(value) > 1 else value[0]}


def _diffuse(*value: float) -> Parts:
    return {"type": "diffuse", "reflectance": _rgb(*value)}


def _metal(alpha: float, material: str = "Cu") -> Parts:
    return {"type": "roughconductor", "material": material, "distribution": "ggx", "alpha": alpha}


def _plastic(alpha: float, *value: float) -> Parts:
    return {"type": "roughplastic", "distribution": "ggx", "alpha": alpha, "diffuse_reflectance": _rgb(*value)}


def _principled(roughness: float, *value: float, metallic: float = 0.0) -> Parts:
    return {
        "type": "principled", "base_color": _rgb(*value), "roughness": roughness, "metallic": metallic, "specular": 0.5,
    }  # fmt: skip


def _tiles() -> Parts:
    """A material whose colours change over the floor, slowly enough not to alias."""
    return {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": mi.Bitmap(_noise(8, 7, 0.25, 0.75)), "raw": True}}


def _noise(size: int, seed: int, low: float, high: float) -> npt.NDArray[np.float32]:
    return np.random.default_rng(seed).uniform(low, high, (size, size, 3)).astype(np.float32)


# ------------------------------------------------------------------------------------------------------------------ shapes


def _floor(bsdf: Parts | None = None, half: float = 4.0) -> Parts:
    return {"type": "rectangle", "to_world": _t().rotate([1, 0, 0], -90) @ _t().scale(half), "bsdf": bsdf or _diffuse(0.5)}


def _wall(at: tuple[float, float, float], axis: list[float], angle: float, half: Size, bsdf: Parts | None = None) -> Parts:
    place = _t().translate(list(at)) @ _t().rotate(axis, angle) @ _t().scale(half)
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf or _diffuse(0.6)}


def _mesh(
    name: str, at: tuple[float, float, float], size: float, bsdf: Parts | None = None, turn: float = 0.0, flat: bool = False
) -> Parts:
    """A mesh of the package, with smooth normals unless ``flat``."""
    place = _t().translate(list(at)) @ _t().rotate([0, 1, 0], turn) @ _t().scale(size)
    return {
        "type": "ply", "filename": str(assets.mesh(name)), "face_normals": flat, "to_world": place,
        "bsdf": {"type": "twosided", "bsdf": bsdf or _diffuse(0.6)},
    }  # fmt: skip


def _ball(at: tuple[float, float, float], radius: float, bsdf: Parts | None = None) -> Parts:
    return {"type": "sphere", "center": list(at), "radius": radius, "bsdf": bsdf or _diffuse(0.7, 0.3, 0.2)}


def _box(at: tuple[float, float, float], half: Size, turn: float = 0.0, bsdf: Parts | None = None) -> Parts:
    place = _t().translate(list(at)) @ _t().rotate([0, 1, 0], turn) @ _t().scale(half)
    return {"type": "cube", "to_world": place, "bsdf": bsdf or _diffuse(0.6)}


# ------------------------------------------------------------------------------------------------------------------ lights


def _area(*radiance: float) -> Parts:
    return {"type": "area", "radiance": _rgb(*radiance)}


def _panel(
    at: tuple[float, float, float], target: tuple[float, float, float], half: Size, emitter: Parts, shape: str = "rectangle"
) -> Parts:
    """A rectangle (or disk) that shines towards a point."""
    up = [0, 1, 0] if abs(at[0] - target[0]) + abs(at[2] - target[2]) > 1e-3 else [0, 0, 1]
    place = _t().look_at(list(at), list(target), up) @ _t().scale(half)
    return {"type": shape, "to_world": place, "emitter": emitter}


def _bulb(at: tuple[float, float, float], radius: float, *radiance: float) -> Parts:
    return {"type": "sphere", "center": list(at), "radius": radius, "emitter": _area(*radiance)}


def _sky(
    sun: tuple[float, float, float],
    peak: float,
    radius: float,
    rows: int = 64,
    turn: float = 0.0,
    tint: tuple[float, float, float] = (0.5, 0.7, 1.0),
) -> Parts:
    """An analytic sky: brighter towards the zenith, dim ground, and a sun of ``radius`` radians in a local direction."""
    theta = (np.arange(rows) + 0.5) / rows * np.pi
    phi = (np.arange(2 * rows) + 0.5) / (2 * rows) * 2 * np.pi
    up = np.cos(theta)[:, None] * np.ones(2 * rows)
    image = np.where(up[..., None] > 0, (0.25 + 0.75 * np.maximum(up, 0))[..., None] * np.asarray(tint), (0.12, 0.1, 0.08))
    directions = np.stack([np.sin(phi) * np.sin(theta)[:, None], up, -np.cos(phi) * np.sin(theta)[:, None]], -1)
    cosine = directions @ (np.asarray(sun) / np.linalg.norm(sun))
    image = image + peak * np.exp(-((np.arccos(np.clip(cosine, -1, 1)) / radius) ** 2))[..., None] * np.array((1.0, 0.9, 0.7))
    return {"type": "envmap", "bitmap": mi.Bitmap(image.astype(np.float32)), "to_world": _t().rotate([0, 1, 0], turn)}


# ------------------------------------------------------------------------------------------------------------------ scenes


def _desk() -> Parts:
    return {
        "floor": _floor(_tiles()),
        "ball": _ball((0.7, 0.5, 0.5), 0.5),
        "box": _box((-1.3, 0.35, 0.7), 0.35, 30),
        "head": _mesh("suzanne", (-0.3, 0.62, -0.6), 0.8, turn=20),
        "lamp": _panel((1.2, 3.2, 1.0), (0, 0.3, 0), 0.5, _area(12, 11, 10)),
    }


def _disk() -> Parts:
    return {
        "floor": _floor(),
        "bunny": _mesh("bunny", (0, 0.8, 0), 0.85, _diffuse(0.6, 0.5, 0.4)),
        "lamp": _panel((-2.0, 2.6, 1.2), (0, 0.5, 0), 0.7, _area(8, 8, 9), "disk"),
    }


def _globe() -> Parts:
    return {
        "floor": _floor(),
        "teapot": _mesh("teapot", (0.2, 0.5, 0.0), 1.0, _plastic(0.3, 0.2, 0.4, 0.6), turn=-30),
        "box": _box((-1.4, 0.3, 0.9), 0.3, 15, _diffuse(0.7, 0.6, 0.2)),
        "lamp": _bulb((1.4, 2.4, 1.3), 0.4, 14, 12, 9),
    }


def _glowing_hand() -> Parts:
    hand = _mesh("hand", (0.0, 1.9, -0.4), 0.6, turn=40)
    return {
        "floor": _floor(),
        "wall": _wall((0, 1.5, -1.8), [0, 1, 0], 0, [4, 1.6, 1]),
        "vase": _mesh("vase", (-1.0, 0.0, 0.3), 0.5, _diffuse(0.7, 0.4, 0.3)),
        "box": _box((0.9, 0.3, 0.5), 0.3, 25),
        "hand": {**{k: v for k, v in hand.items() if k != "bsdf"}, "emitter": _area(8, 6, 4)},
    }


def _lightbox() -> Parts:
    return {
        "floor": _floor(_tiles()),
        "head": _mesh("suzanne", (-0.4, 0.55, 0.0), 0.75, turn=25),
        "ball": _ball((0.9, 0.35, 0.9), 0.35, _plastic(0.3, 0.3, 0.5, 0.3)),
        "lamp": {
            "type": "cube", "to_world": _t().translate([1.1, 2.2, 0.6]) @ _t().rotate([0.3, 1, 0.2], 35) @ _t().scale(0.3),
            "emitter": _area(14, 13, 11),
        },
    }  # fmt: skip


def _tube() -> Parts:
    return {
        "floor": _floor(),
        "wall": _wall((0, 1.5, -1.8), [0, 1, 0], 0, [4, 1.6, 1]),
        "teapot": _mesh("teapot", (-0.5, 0.45, 0.2), 0.8, _diffuse(0.6, 0.5, 0.4), turn=20),
        "box": _box((1.0, 0.3, 0.6), 0.3, 25),
        "lamp": {
            "type": "cylinder", "p0": [-1.4, 2.4, 0.9], "p1": [1.4, 2.2, 0.3], "radius": 0.08, "emitter": _area(14, 15, 17),
        },
    }  # fmt: skip


def _painted() -> Parts:
    """A scene with a lamp like a stained window: bars in three colours on black."""
    image = np.zeros((8, 8, 3), np.float32)
    image[:, 0:2], image[:, 3:5], image[:, 6:8] = (20, 4, 2), (3, 16, 3), (2, 5, 22)
    radiance = {"type": "bitmap", "bitmap": mi.Bitmap(image), "raw": True, "filter_type": "nearest"}
    return {
        "floor": _floor(_diffuse(0.7)),
        "wall": _wall((0, 1.5, -1.8), [0, 1, 0], 0, [4, 1.6, 1]),
        "spot": _mesh("spot", (0.2, 0.7, 0.1), 0.7, turn=60),
        "pole": _box((-1.0, 0.6, 0.2), [0.07, 0.6, 0.07]),
        "lamp": _panel((-1.6, 2.4, 2.2), (0, 0.4, 0), [0.9, 0.6, 1], {"type": "area", "radiance": radiance}),
    }


def _two_colours() -> Parts:
    return {
        "floor": _floor(),
        "dragon": _mesh("dragon", (0, 0.75, 0), 1.05, _diffuse(0.7)),
        "warm": _panel((-2.6, 2.0, 1.0), (0, 0.5, 0), 0.4, _area(22, 9, 3)),
        "cold": _bulb((2.4, 2.2, 0.6), 0.3, 4, 10, 26),
    }


def _lantern() -> Parts:
    """A scene around its lamp, which needs shadow maps in all directions."""
    around = [_box((1.1 * np.cos(a), 0.45, 1.1 * np.sin(a)), [0.12, 0.45, 0.12], 45) for a in np.arange(5) * 2 * np.pi / 5 + 0.3]
    return {
        "floor": _floor(),
        "back": _wall((0, 1.5, -2.4), [0, 1, 0], 0, [4, 1.6, 1]),
        "side": _wall((-2.4, 1.5, 0), [0, 1, 0], 90, [4, 1.6, 1], _diffuse(0.6, 0.3, 0.3)),
        **{f"post_{k}": post for k, post in enumerate(around)},
        "lamp": _bulb((0, 0.7, 0), 0.18, 14, 12, 9),
    }


def _room() -> Parts:
    lamp = _wall((0, 1.995, 0), [1, 0, 0], 90, [0.35, 0.3, 1])
    lamp.pop("bsdf")
    return {
        "floor": _floor(_diffuse(0.7), 1.0),
        "ceiling": _wall((0, 2, 0), [1, 0, 0], 90, 1, _diffuse(0.7)),
        "back": _wall((0, 1, -1), [0, 1, 0], 0, 1, _diffuse(0.7)),
        "left": _wall((-1, 1, 0), [0, 1, 0], 90, 1, _diffuse(0.6, 0.06, 0.05)),
        "right": _wall((1, 1, 0), [0, 1, 0], -90, 1, _diffuse(0.12, 0.45, 0.1)),
        "tall": _box((-0.35, 0.6, -0.35), [0.28, 0.6, 0.28], 18, _diffuse(0.7)),
        "short": _box((0.38, 0.28, 0.3), 0.28, -18, _diffuse(0.7)),
        "lamp": {**lamp, "emitter": _area(17, 12, 5)},
    }


def _overcast() -> Parts:
    return {
        "floor": _floor(),
        "drape": _mesh("drape", (-0.2, 0.75, -0.5), 1.1, _diffuse(0.7, 0.6, 0.4)),
        "head": _mesh("suzanne", (0.9, 0.5, 0.9), 0.5, turn=-20),
        "ball": _ball((-0.9, 0.35, 1.1), 0.35),
        "sky": {"type": "constant", "radiance": _rgb(0.6, 0.7, 0.9)},
    }


def _sunny() -> Parts:
    return {
        "floor": _floor(_tiles()),
        "spot": _mesh("spot", (-0.4, 0.75, 0), 0.75, turn=140),
        "ball": _ball((1.0, 0.4, 0.6), 0.4, _plastic(0.3, 0.5, 0.2, 0.2)),
        "sky": _sky((0.5, 0.8, 0.45), 120.0, 0.05, 128, turn=70),
    }


def _dusk() -> Parts:
    return {
        "floor": _floor(_principled(0.5, 0.5, 0.45, 0.4)),
        "bunny": _mesh("bunny", (-0.6, 0.7, 0), 0.7, _metal(0.3)),
        "vase": _mesh("vase", (0.8, 0.0, 0.2), 0.6, _principled(0.4, 0.2, 0.3, 0.7)),
        "sky": _sky((1, 0.25, 0.6), 8.0, 0.35, 64, turn=-30, tint=(0.5, 0.35, 0.5)),
    }


def _noon() -> Parts:
    return {
        "floor": _floor(_diffuse(0.5, 0.45, 0.4), 20.0),
        "spot": _mesh("spot", (-0.4, 0.75, 0), 0.75, turn=140),
        "ball": _ball((1.0, 0.4, 0.6), 0.4, _plastic(0.35, 0.5, 0.2, 0.2)),
        "sky": {
            "type": "sunsky", "sun_direction": [0.5, 0.7, 0.6], "turbidity": 4.0, "to_world": _t().rotate([1, 0, 0], -90),
        },
    }  # fmt: skip


def _everything() -> Parts:
    return {
        "floor": _floor(_tiles()),
        "dragon": _mesh("dragon", (-0.3, 0.65, -0.4), 0.9, _diffuse(0.6)),
        "ball": _ball((1.1, 0.4, 0.7), 0.4, _plastic(0.35, 0.3, 0.5, 0.3)),
        "box": _box((-1.4, 0.3, 0.9), 0.3, 30),
        "lamp": _panel((1.8, 2.6, 1.4), (0, 0.3, 0), 0.4, _area(8, 7, 5)),
        "sky": _sky((0.3, 1.0, 0.2), 3.0, 0.25, 32, turn=20, tint=(0.2, 0.25, 0.35)),
        "sun": {"type": "directional", "direction": [0.6, -1.0, -0.5], "irradiance": _rgb(0.6, 0.5, 0.4)},
        "torch": {
            "type": "spot", "to_world": _t().look_at([-2.5, 2.2, 1.5], [-0.5, 0.3, 0], [0, 1, 0]), "intensity": _rgb(6, 3, 3),
            "cutoff_angle": 25.0, "beam_width": 18.0,
        },
        "bulb": {"type": "point", "position": [0.3, 1.9, 1.6], "intensity": _rgb(0.5, 0.6, 1.0)},
    }  # fmt: skip


def _metals() -> Parts:
    return {
        "floor": _floor(_plastic(0.4, 0.4, 0.4, 0.45)),
        "wall": _wall((0, 1.5, -1.8), [0, 1, 0], 0, [4, 1.6, 1]),
        "ball": _ball((-0.9, 0.55, 0.2), 0.55, _metal(0.3, "Au")),
        "head": _mesh("suzanne", (0.7, 0.6, 0.2), 0.75, _principled(0.35, 0.8, 0.5, 0.3, metallic=0.8), turn=-15),
        "lamp": _panel((0.3, 2.9, 2.0), (0, 0.4, 0), [0.8, 0.4, 1], _area(7, 7, 7)),
    }


def _gallery() -> Parts:
    return {
        "floor": _floor(_diffuse(0.4, 0.35, 0.3)),
        "back": _wall((0, 1.5, -2.0), [0, 1, 0], 0, [4, 1.6, 1]),
        "teapot": _mesh("teapot", (-1.2, 0.45, 0), 0.8, _metal(0.35, "Al"), turn=20),
        "hand": _mesh("hand", (0.1, 0.75, -0.5), 0.75, _diffuse(0.6, 0.5, 0.45)),
        "vase": _mesh("vase", (1.3, 0.0, 0.1), 0.6, _plastic(0.3, 0.3, 0.2, 0.5)),
        "first": _panel((-1.6, 2.6, 1.2), (-1.2, 0.3, 0), 0.25, _area(26, 24, 20), "disk"),
        "second": _panel((0.2, 2.7, 1.0), (0.1, 0.5, -0.5), [0.5, 0.2, 1], _area(16, 16, 18)),
        "third": _bulb((1.9, 2.3, 1.0), 0.2, 24, 20, 16),
    }


def _glossy_lamp() -> Parts:
    return {
        "floor": _floor(_plastic(0.1, 0.3, 0.3, 0.35)),
        "ball": _ball((-0.8, 0.55, 0.0), 0.55, _metal(0.12, "Au")),
        "vase": _mesh("vase", (0.8, 0.0, 0.2), 0.6, _principled(0.2, 0.7, 0.3, 0.2)),
        "lamp": _panel((0.6, 2.8, -1.2), (0, 0.3, 0), [0.6, 0.4, 1], _area(8, 8, 8)),
    }


def _glossy_sky() -> Parts:
    return {
        "floor": _floor(),
        "ball": _ball((-0.8, 0.55, 0.0), 0.55, _metal(0.1, "Au")),
        "bunny": _mesh("bunny", (0.7, 0.6, 0.2), 0.6, _plastic(0.15, 0.2, 0.4, 0.3)),
        "sky": _sky((0.5, 0.8, 0.6), 30.0, 0.12, 64, turn=40),
    }


_LOW_VIEW = ((0.0, 2.4, 5.6), (0.0, 0.75, 0.0))

SCENES: Mapping[str, SoftScene] = {
    "desk": SoftScene(_desk, "rectangle"),
    "disk": SoftScene(_disk, "disk"),
    "globe": SoftScene(_globe, "sphere; plastic 0.3"),
    "glowing_hand": SoftScene(_glowing_hand, "a mesh, not convex, in view", _LOW_VIEW),
    "lightbox": SoftScene(_lightbox, "cube; plastic 0.3"),
    "tube": SoftScene(_tube, "thin cylinder"),
    "painted": SoftScene(_painted, "textured rectangle"),
    "two_colours": SoftScene(_two_colours, "rectangle and sphere of different colours"),
    "lantern": SoftScene(_lantern, "sphere in the middle of the scene", ((1.6, 3.0, 4.6), (0.0, 0.4, -0.2))),
    "room": SoftScene(_room, "ceiling lamp in a room", ((0.0, 1.0, 4.4), (0.0, 1.0, 0.0)), 34.0),
    "overcast": SoftScene(_overcast, "constant"),
    "sunny": SoftScene(_sunny, "envmap with a small, bright sun, turned; plastic 0.3"),
    "dusk": SoftScene(_dusk, "envmap with a large sun; metal 0.3, principled 0.4 and 0.5"),
    "noon": SoftScene(_noon, "sunsky; plastic 0.35"),
    "everything": SoftScene(_everything, "rectangle, envmap, directional, spot and point; plastic 0.35"),
    "metals": SoftScene(_metals, "rectangle; metal 0.3, plastic 0.4, principled 0.35", _LOW_VIEW),
    "gallery": SoftScene(_gallery, "disk, rectangle and sphere; metal 0.35, plastic 0.3", _LOW_VIEW),
    "glossy_lamp": SoftScene(_glossy_lamp, "rectangle; metal 0.12, plastic 0.1, principled 0.2", _LOW_VIEW, glossy=True),
    "glossy_sky": SoftScene(_glossy_sky, "envmap; metal 0.1, plastic 0.15", _LOW_VIEW, glossy=True),
}

"""Small scenes under lamps and skies."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

SKY = np.random.default_rng(3).uniform(0, 1, (8, 16, 3)).astype(np.float32)


def lit_scene(kind: str) -> Any:
    if kind == "sky":
        lights: dict[str, Any] = {"sky": {"type": "envmap", "bitmap": mi.Bitmap(SKY)}}
    else:
        slanted = mi.ScalarTransform4f().look_at([0.3, 1.4, 0.2], [0, 0, 0], [0, 0, 1])
        lights = {
            "lamp": panel(1.2, 0.3),
            "bulb": {"type": "point", "position": [0.5, 1.2, 0.5], "intensity": 0.3},
            "torch": {"type": "spot", "to_world": slanted, "intensity": 1.0},
        }
    return scene_of(camera=view(), box=box(), **lights)


SIZE = 24
ALBEDO = 0.5


def camera(size: int = SIZE, height: float = 0.4, half: float = 0.05, **film: Any) -> dict[str, Any]:
    """Looks straight down at the origin from below all lamps; ``half``: half-size of what it sees of the floor."""
    T = mi.ScalarTransform4f
    to_world = T().look_at([0, height, 0], [0, 0, 0], [0, 0, 1]) @ T().scale([half, half, 1])
    settings = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb", **film}
    return {"type": "orthographic", "near_clip": 0.01, "far_clip": 100.0, "to_world": to_world, "film": settings}


def view(size: int = SIZE, **film: Any) -> dict[str, Any]:
    """Looks at the scene at an angle."""
    to_world = mi.ScalarTransform4f().look_at([0, 2.5, 4], [0, 0.4, 0], [0, 1, 0])
    settings = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb", **film}
    return {"type": "perspective", "fov": 40, "to_world": to_world, "film": settings}


def scene_of(**parts: Any) -> Any:
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90) @ mi.ScalarTransform4f().scale(3)}
    full = {"type": "scene", "camera": camera(), "floor": floor, **parts}
    return mi.load_dict({key: part for key, part in full.items() if part is not None}, optimize=False)


def area(*radiance: float) -> dict[str, Any]:
    return {"type": "area", "radiance": {"type": "rgb", "value": list(radiance) if len(radiance) > 1 else radiance[0]}}


def panel(height: float = 1.0, half: float = 0.5, kind: str = "rectangle", down: bool = True, **more: Any) -> dict[str, Any]:
    T = mi.ScalarTransform4f
    place = T().translate([0, height, 0]) @ T().rotate([1, 0, 0], 90 if down else -90) @ T().scale(half)
    return {"type": kind, "to_world": place, "emitter": area(2.0), **more}


def box(x: float = 0.6, y: float = 0.3, size: float = 0.2) -> dict[str, Any]:
    T = mi.ScalarTransform4f
    return {"type": "cube", "to_world": T().translate([x, y, 0.2]) @ T().rotate([0, 1, 0], 30) @ T().scale(size)}

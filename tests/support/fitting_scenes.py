"""Small scenes of the tests of fits."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from shadowmap_dr import Renderer

# Few look-ups: kernels that compile quickly.
OPTIONS: dict[str, Any] = {"shadow_map_resolution": 64, "shadow_filter_size": 5, "shadow_samples": 1}


def rgb(*values: float) -> dict[str, Any]:
    return {"type": "rgb", "value": list(values) if len(values) > 1 else values[0]}


def diffuse(*values: float) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": rgb(*values)}


def camera(width: int = 32, height: int = 24, film: dict[str, Any] | None = None, **changes: Any) -> dict[str, Any]:
    base = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    to_world = mi.ScalarTransform4f().look_at([2, -3, 4], [0, 0, 0], [0, 0, 1])
    return {"type": "perspective", "fov": 45, "to_world": to_world, "film": {**base, **(film or {})}, **changes}


def box(x: float, y: float = 0.0, *colour: float) -> dict[str, Any]:
    T = mi.ScalarTransform4f
    place = T().translate([x, y, 0.5]) @ T().rotate([1, 2, 0.5], 25) @ T().scale([0.45, 0.3, 0.4])
    return {"type": "cube", "to_world": place, "bsdf": diffuse(*(colour or (0.7, 0.5, 0.3)))}


def floor() -> dict[str, Any]:
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(4), "bsdf": diffuse(0.5, 0.5, 0.5)}


def sun(**changes: Any) -> dict[str, Any]:
    return {"type": "directional", "direction": [0.4, 0.3, -1], "irradiance": rgb(2.0, 1.5, 1.0), **changes}


def scene_of(**parts: Any) -> mi.Scene:
    """A box on a floor under the sun; None leaves a part out."""
    direct = {"type": "direct"}
    full = {"type": "scene", "integrator": direct, "camera": camera(), "box": box(0), "floor": floor(), "sun": sun(), **parts}
    return mi.load_dict({name: part for name, part in full.items() if part is not None}, optimize=False)


def renderer_of(**parts: Any) -> Renderer:
    return Renderer.from_scene(scene_of(**parts), **OPTIONS)


def varied_scene() -> mi.Scene:
    """All kinds of things that can vary."""
    T = mi.ScalarTransform4f
    picture = np.linspace(0.1, 0.9, 96, dtype=np.float32).reshape(4, 8, 3)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(picture), "raw": True}
    film = {"type": "hdrfilm", "width": 32, "height": 24}
    glossy = {"type": "roughplastic", "diffuse_reflectance": rgb(0.2, 0.4, 0.6), "alpha": 0.2}
    return scene_of(
        box=None,
        car_body=box(-1),
        car_wheel=box(1),
        ball={"type": "sphere", "center": [0, 1, 0.5], "radius": 0.4, "bsdf": glossy},
        floor={**floor(), "bsdf": {"type": "diffuse", "reflectance": texture}},
        panel={
            "type": "rectangle",
            "to_world": T().translate([0, 0, 4]).rotate([1, 0, 0], 180),
            "emitter": {"type": "area", "radiance": rgb(2, 3, 4)},
        },
        lamp={"type": "point", "position": [1.5, 0, 2.5], "intensity": rgb(4, 3, 2)},
        spot={
            "type": "spot",
            "to_world": T().look_at([1, 1, 4], [0, 0, 0], [0, 1, 0]),
            "cutoff_angle": 30,
            "intensity": rgb(4, 4, 4),
        },
        sky={"type": "constant", "radiance": rgb(0.3, 0.3, 0.3)},
        flat={"type": "orthographic", "to_world": T().look_at([2, -3, 4], [0, 0, 0], [0, 0, 1]), "film": film},
    )

"""The scene of the tests of the functional renderer: a ball over a floor in the light of the sun and a lamp."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import trimesh

from shadowmap_dr import Renderer

SIZE = 48
# No hidden dependence of the number of look-ups on the size of the image.
OPTIONS = {"shadow_map_resolution": 64, "shadow_filter_size": 5, "shadow_samples": 1}


def ball(name: str, center: list[float], radius: float = 0.5, smooth: bool = True) -> Any:
    """A ``mi.Mesh`` of a sphere."""
    sphere = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    mesh = mi.Mesh(name, len(sphere.vertices), len(sphere.faces), has_vertex_normals=smooth)
    params = mi.traverse(mesh)
    params["vertex_positions"] = (np.asarray(sphere.vertices) + center).astype(np.float32).ravel()
    params["faces"] = np.asarray(sphere.faces).astype(np.uint32).ravel()
    params.update()
    # Mitsuba sums face normals in any order: those of two equal balls may differ in the last bit, and so would their pictures.
    if smooth:
        params["vertex_normals"] = np.asarray(sphere.vertices / radius).astype(np.float32).ravel()
        params.update()
    return mesh


def camera(width: int = SIZE, height: int = SIZE, **changes: Any) -> dict[str, Any]:
    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    to_world = mi.ScalarTransform4f().look_at([2, -3, 4], [0, 0, 0], [0, 0, 1])
    return {"type": "perspective", "fov": 45, "to_world": to_world, "film": film, **changes}


def build(**changes: Any) -> Any:
    """A ball over a floor in the light of the sun and a lamp."""
    parts = {
        "type": "scene",
        "ball": ball("ball", [0, 0, 0.9]),
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3)},
        "camera": camera(),
        "sun": {"type": "directional", "direction": [0.4, 0.3, -1], "irradiance": {"type": "rgb", "value": 2.0}},
        "lamp": {"type": "point", "position": [1.5, 0, 2.5], "intensity": {"type": "rgb", "value": [4.0, 3.0, 2.0]}},
        **changes,
    }
    return mi.load_dict({k: v for k, v in parts.items() if v is not None}, optimize=False)


def renderer_of(**changes: Any) -> Renderer:
    return Renderer.from_scene(build(**changes), **OPTIONS)


def rest(renderer: Renderer, name: str = "ball") -> Any:
    return renderer.data.geometry.shape_positions(name)

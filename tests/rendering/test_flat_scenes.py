"""Lit surfaces of scenes in which little or nothing casts shadows: floors alone, gentle relief."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from translucent_scenes import lights, scene_of

from shadowmap_dr import Renderer


def relief() -> mi.Mesh:
    """Waves that are 6 cm high and 2 m long, on a square of 4 m."""
    count = 33
    x, y = np.meshgrid(*2 * [np.linspace(-2, 2, count)])
    points = np.stack([x, y, 0.03 * np.sin(3 * x) * np.cos(2 * y)], -1).reshape(-1, 3)
    first = np.arange((count - 1) * count).reshape(count - 1, count)[:, :-1].ravel()
    faces = [np.stack([first + a, first + b, first + count], 1) for a, b in ((0, 1), (1, count + 1))]
    mesh = mi.Mesh("relief", len(points), 2 * len(first))
    params = mi.traverse(mesh)
    params["vertex_positions"], params["faces"] = points.ravel().astype(np.float32), np.concatenate(faces).ravel()
    params.update()
    return mesh


def least_share(scene: mi.Scene, **settings: Any) -> float:
    """Least share of the light that shadows leave to a pixel."""
    lit, dark = (np.array(Renderer.from_scene(scene, **each).render()) for each in ({"shadow_method": "none"}, settings))
    seen = lit.sum(-1) > 0
    return float((dark[seen] / np.maximum(lit[seen], 1e-6)).min())


@pytest.mark.parametrize("far", [False, True])
@pytest.mark.parametrize("light", ["sun", "spot", "point", "area", "sky"])
def test_a_floor_alone_is_lit(variant: str, light: str, far: bool) -> None:
    """With nothing on it, or with a ball whose shadow is out of view: maps of 256 texels had borders up to 15 % too dark."""
    ball = {"type": "sphere", "center": [30, 0, 0.35], "radius": 0.25} if far else None
    for settings in ({}, {"shadow_map_resolution": 64}, {"soft_map_resolution": 32}):
        assert least_share(scene_of(128, lights()[light], ball=ball), **settings) > 0.999


@pytest.mark.parametrize("light", ["sun", "spot", "point"])
@pytest.mark.parametrize("resolution", [64, 256, 512])
def test_gentle_relief_is_lit(variant: str, light: str, resolution: int) -> None:
    """Heights are a few hundredths of the map's width: edges between faces were lines with up to 60 % shadow."""
    down = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    above = {
        "sun": {"type": "directional", "direction": [0.02, 0.01, -1]},
        "spot": {"type": "spot", "to_world": down, "intensity": 40.0, "cutoff_angle": 40},
        "point": {"type": "point", "position": [0, 0, 6], "intensity": 60.0},
    }
    scene = scene_of(128, above[light], floor=relief(), ball=None)
    assert least_share(scene, shadow_map_resolution=resolution) > 0.98

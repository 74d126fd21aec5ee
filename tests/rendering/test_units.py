"""Scenes in other units of length, and cameras whose transformation scales, are the same scenes."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from integrator_scenes import image_and_derivative

from shadowmap_dr import Renderer

SIZE = 48


def scene(unit: float = 1.0, zoom: Any = 1.0, **camera: Any) -> Any:
    """A tile above a floor, everything ``unit`` times as large."""
    T, far = mi.ScalarTransform4f, {"near_clip": 0.01, "far_clip": 1e7}
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    look = T().look_at([0, -3 * unit, 2 * unit], [0, 0, 0], [0, 0, 1]) @ T().scale(zoom)
    tile = T().scale(unit) @ T().translate([0, 0, 0.05]) @ T().rotate([0, 0, 1], 20) @ T().scale(0.5)
    dark = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.1}}
    return mi.load_dict({
        "type": "scene",
        "camera": {"type": "perspective", "to_world": look, "film": film, **far, **camera},
        "tile": {"type": "rectangle", "to_world": tile},
        "floor": {"type": "rectangle", "to_world": T().scale(3 * unit), "bsdf": dark},
        "sun": {"type": "directional", "direction": [0.2, 0.1, -1]},
    })  # fmt: skip


def lifted(made: Any, unit: float) -> tuple[np.ndarray, np.ndarray]:
    return image_and_derivative(made, "tile", (0, 0, unit), shadow_map_resolution=128)


@pytest.mark.parametrize("unit", [0.01, 1000.0, 10_000.0])
def test_units_do_not_matter(variant: str, unit: float) -> None:
    """Nor that the near plane, 0.01 from the camera, is then a millionth of the way to what it sees."""
    expected, derivative = lifted(scene(), 1)
    found, other = lifted(scene(unit), unit)
    assert np.abs(found - expected).mean() < 2e-3 * expected.mean()
    assert np.abs(other - derivative).sum() < 0.03 * np.abs(derivative).sum()


def test_the_near_plane_does_not_matter(variant: str) -> None:
    expected, derivative = lifted(scene(near_clip=0.1), 1)
    found, other = lifted(scene(near_clip=1e-5), 1)
    np.testing.assert_allclose(found, expected, atol=1e-4)
    assert np.abs(other - derivative).sum() < 0.01 * np.abs(derivative).sum()


@pytest.mark.parametrize("zoom", [0.5, 1.5, 0.05])
def test_orthographic_cameras_may_scale_depths_too(variant: str, zoom: float) -> None:
    """Mitsuba shows the same whether the third number is 1 or not, and so does this renderer."""
    flat, cubic = (
        Renderer.from_scene(scene(zoom=size, type="orthographic"), shadow_map_resolution=64).render()
        for size in ([zoom, zoom, 1], [zoom, zoom, zoom])
    )
    assert (np.array(flat).max(2) > 0).mean() > 0.5
    np.testing.assert_allclose(np.array(cubic), np.array(flat), atol=2e-3)

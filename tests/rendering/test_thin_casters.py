"""Casters at the limits of shadow maps: thinner than a texel, and very near a lamp. The numbers of docs/limits.md."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr.rendering.renderer import Renderer

SIDE, LENGTH = 64, 1.2
TEXEL = 2 / SIDE  # the map is fitted to what is seen


def darkness(width: float, angle: float, length: float, offset: float) -> float:
    """Darkness on a floor under a bar, over that of the bar's area. ``width`` and ``offset`` in texels."""
    t = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": SIDE, "height": SIDE, "rfilter": {"type": "box"}}
    turned = t().translate([offset * TEXEL, 0, 2]).rotate([0, 0, 1], angle)
    scene = mi.load_dict(
        {
            "type": "scene",
            "camera": {"type": "orthographic", "to_world": t().look_at([0, 0, 1], [0, 0, 0], [0, 1, 0]), "film": film},
            "floor": {"type": "rectangle", "to_world": t().scale(2)},
            "bar": {"type": "rectangle", "to_world": turned.scale([width * TEXEL / 2, length / 2, 1])},
            "sun": {"type": "directional", "direction": [0, 0, -1], "irradiance": float(np.pi)},
        },
        optimize=False,
    )
    image = np.array(Renderer.from_scene(scene, shadow_map_resolution=SIDE, aovs=("visibility",)).render())
    return float((1 - image[..., 3]).sum() * TEXEL**2 / (width * TEXEL * length))


def found(width: float, angle: float, length: float = LENGTH) -> list[float]:
    return [darkness(width, angle, length, k / 4) for k in range(4)]


@pytest.mark.parametrize("width", [0.5, 0.1])
def test_slanted_bars_are_as_dark_as_their_area(variant: str, width: float) -> None:
    np.testing.assert_allclose(found(width, 30), 1, atol=0.02)


def test_bars_parallel_to_the_texels(variant: str) -> None:
    np.testing.assert_allclose(found(0.5, 0), 1, atol=0.04)
    thin = found(0.25, 0)
    assert min(thin) < 0.01 and max(thin) == pytest.approx(2, abs=0.1) and np.mean(thin) == pytest.approx(1, abs=0.05)


def test_specks_between_the_centres_of_texels_cast_no_shadow(variant: str) -> None:
    specks = found(0.4, 30, 0.4 * TEXEL)
    assert min(specks) == 0 and max(specks) < 0.2


@pytest.mark.parametrize(("distance", "visibility"), [(0.012, 0), (0.008, 1)])
def test_casters_a_thousand_times_nearer_than_the_farthest_cast_no_shadow(variant: str, distance: float, visibility: int) -> None:
    t = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 9, "height": 9, "rfilter": {"type": "box"}}
    camera = {"type": "perspective", "fov": 5, "to_world": t().look_at([0, -0.5, 4], [0, 0, -9.9], [0, 1, 0]), "film": film}
    scene = mi.load_dict(
        {
            "type": "scene",
            "camera": camera,
            "room": {"type": "cube", "to_world": t().scale(10), "flip_normals": True},
            "caster": {"type": "rectangle", "to_world": t().translate([0, 0, -distance]).scale(0.1 * distance)},
            "lamp": {"type": "point", "position": [0, 0, 0], "intensity": 100.0},
        },
        optimize=False,
    )
    image = np.array(Renderer.from_scene(scene, aovs=("visibility",)).render())
    np.testing.assert_allclose(image[..., 3], visibility, atol=1e-4)

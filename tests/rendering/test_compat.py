"""The authors' conventions in whole images."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr import Renderer


@pytest.fixture
def scene_of(variant: str):  # noqa: ANN201
    def build(light: dict) -> object:
        return mi.load_dict(
            {
                "type": "scene",
                "sensor": {
                    "type": "orthographic",
                    "to_world": mi.ScalarTransform4f().look_at([0, 0, 2], [0, 0, 0], [0, 1, 0]) @ mi.ScalarTransform4f().scale(2),
                    "film": {"type": "hdrfilm", "width": 64, "height": 64, "rfilter": {"type": "box"}},
                },
                "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(2)},
                "light": light,
            },
            optimize=False,
        )

    return build


def test_spots_are_square_and_without_falloff(variant: str, scene_of) -> None:  # noqa: ANN001
    height, angle = 1.5, 35.0
    to_world = mi.ScalarTransform4f().look_at([0, 0, height], [0, 0, 0], [0, 1, 0])
    light = {"type": "spot", "intensity": 2.0, "cutoff_angle": angle, "beam_width": 20.0, "to_world": to_world}
    image = Renderer.from_scene(scene_of(light), compat=True).render().numpy()[..., 0]
    coordinate = 2 * ((np.arange(64) + 0.5) / 32 - 1)
    x, y = np.meshgrid(coordinate, coordinate)
    half = height * np.tan(np.radians(angle))
    reach = np.maximum(np.abs(x), np.abs(y))
    lit = 2.0 * 0.5 / np.pi * height / np.sqrt(x * x + y * y + height**2)
    inner, outer = reach < half - 0.1, reach > half + 0.1
    np.testing.assert_allclose(image[inner], lit[inner], rtol=2e-3)
    assert image[outer].max() < 1e-4
    own = Renderer.from_scene(scene_of(light)).render().numpy()[..., 0]
    corner = (np.abs(x) > 0.8 * half) & (np.abs(y) > 0.8 * half) & inner
    assert own[corner].max() == 0 and image[corner].min() > 0.1


def test_directional_lights_are_dark_outside_of_their_map_only(variant: str, scene_of) -> None:  # noqa: ANN001
    light = {"type": "directional", "direction": [0.2, 0.1, -1.0], "irradiance": 1.0}
    image = Renderer.from_scene(scene_of(light), compat=True).render().numpy()[..., 0]
    np.testing.assert_allclose(image, 0.5 / np.pi / np.sqrt(1.05), rtol=2e-3)

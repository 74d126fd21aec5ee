"""Shadows on a plane without a camera."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from face_models import egg

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.faces.problem import FaceScene, light_directions, path_traced_shadow
from shadowmap_dr.rendering.receivers.planar_receiver import ReceiverShadows, Window
from shadowmap_dr.shadow import ShadowSettings

SQUARE = np.array([[-0.4, -0.3, 0.5], [0.4, -0.3, 0.5], [0.4, 0.3, 0.5], [-0.4, 0.3, 0.5]], np.float32)
FACES = np.array([[0, 1, 2], [0, 2, 3]])
WINDOW = Window((-1.0, -0.8), (1.2, 0.8))


def shadows(directions: list[tuple[float, float, float]], height: int = 64) -> ReceiverShadows:
    settings = ShadowSettings(method="vsm", resolution=128)
    return ReceiverShadows.build(FACES, SQUARE, directions, WINDOW, height, settings, 4.0)


def positions_of(shadow: np.ndarray, made: ReceiverShadows) -> tuple[float, np.ndarray]:
    """Area of a shadow, and its centre."""
    dark = 1 - shadow
    points = np.array(made.points)[:2]
    pixel = (WINDOW.size[0] / made.shape[1]) * (WINDOW.size[1] / made.shape[0])
    return float(dark.sum() * pixel), points @ dark / dark.sum()


def test_a_slanting_light_moves_the_shadow(variant: str) -> None:
    """A square 2.5 before the wall: its shadow has its area, and lies where light that passes it strikes."""
    made = shadows([(0.1, -0.05, -1.0)])
    area, centre = positions_of(np.array(made.render(mi.Float(SQUARE.ravel()))), made)
    assert abs(area / 0.48 - 1) < 2e-3
    np.testing.assert_allclose(centre, [0.25, -0.125], atol=2e-3)


def test_visibility_is_what_is_not_covered(variant: str) -> None:
    """A texel holds two depths, for which a variance shadow map is exact: edges are as wide as the filter, and symmetric."""
    made = shadows([(0, 0, -1)])
    image = np.array(made.render(mi.Float(SQUARE.ravel()))).reshape(made.shape)
    assert image.min() < 1e-3 and image.max() == 1
    half = image[made.shape[0] // 2]
    x = np.array(made.points)[0].reshape(made.shape)[0]
    crossing = np.interp(0.5, half[len(half) // 2 :], x[len(half) // 2 :])
    assert abs(crossing - 0.4) < 1e-3


def test_derivatives_in_both_modes(variant: str) -> None:
    """A square that grows: the area of its shadow follows."""
    made = shadows([(0, 0, -1), (0.1, 0, -1)])
    pixel = (WINDOW.size[0] / made.shape[1]) * (WINDOW.size[1] / made.shape[0])

    def area(growth) -> object:  # noqa: ANN001
        factor = dr.gather(mi.Float, growth, dr.zeros(mi.UInt32, SQUARE.size))
        return dr.sum(1 - made.render(mi.Float(SQUARE.ravel()) * dr.select(mi.Bool([True, True, False] * 4), factor, 1))) * pixel

    growth = mi.Float(1)
    dr.enable_grad(growth)
    dr.backward(area(growth))
    assert abs(dr.grad(growth)[0] / 0.96 - 1) < 0.02
    growth = mi.Float(1)
    dr.enable_grad(growth)
    value = area(growth)
    dr.forward(growth)
    assert abs(dr.grad(value)[0] / 0.96 - 1) < 0.02


@pytest.mark.parametrize("lights", [1, 3])
def test_images_are_those_of_a_path_tracer(variant: str, lights: int) -> None:
    """With a camera between head and wall; they differ at outlines only, which the filter softens."""
    model = egg()
    scene = FaceScene.build(model, lights, height=48, map_resolution=128)
    ours, traced = scene.shadow(model.mean), path_traced_shadow(scene, model.mean, 64)
    assert ours.shape == traced.shape
    assert abs(ours.mean() - traced.mean()) < 2e-3
    assert np.mean(np.abs(ours - traced)) < 0.012
    assert np.quantile(np.abs(ours - traced), 0.85) < 0.01
    assert traced.min() < 0.05 < 0.95 < traced.max()


def test_bad_input(variant: str) -> None:
    with pytest.raises(ShadowmapError, match="misses the receiver"):
        shadows([(0, 0, 1)])
    with pytest.raises(ShadowmapError, match="growing, finite"):
        Window((0, 0), (0, 1))
    assert np.isclose(light_directions(3)[2][0], -np.sin(np.radians(15)))

"""Pictures of a fit: differences in colours, brightness of displays, errors in words."""

from __future__ import annotations

import math

import numpy as np
import pytest
from fit_results import picture

from shadowmap_dr.fitting import display


def test_differences_are_blue_where_darker_and_red_where_brighter() -> None:
    target, weight = np.full((1, 4, 3), 0.5), np.array([[1.0, 1.0, 1.0, 0.0]])
    image = target + np.array([-0.1, 0.0, 0.1, 0.3])[None, :, None]
    values = display.difference(image, target, weight)
    np.testing.assert_allclose(values, [[-0.2, 0, 0.2, 0.6]], atol=1e-12)
    end = display.limit(values, weight)
    assert end == pytest.approx(0.2)
    darker, same, brighter, masked = display.difference_colours(values, weight, end)[0].astype(int)
    assert darker[2] > darker[0] + 50 and brighter[0] > brighter[2] + 50
    assert same.min() > 240 and masked.min() == masked.max()
    assert display.difference_colours(values, weight, end, (3, 8)).shape == (3, 8, 3)


@pytest.mark.parametrize(
    ("most", "end"), [(0.0, 0.01), (0.0123, 0.015), (1.05, 1.2), (9.5, 10.0), (0.4, 0.4), (7.1, 8.0), (1e-9, 1e-6)]
)
def test_scales_end_at_round_numbers(most: float, end: float) -> None:
    assert display.limit(np.full((4, 4), -most), np.ones((4, 4))) == pytest.approx(end)


def test_dim_and_bright_targets_are_displayed_with_another_brightness() -> None:
    usual = picture()
    assert display.gain(usual) == 1
    assert display.gain(picture(target=usual.target / 100)) == pytest.approx(100 / 0.8)
    assert display.gain(picture(target=usual.target * 100)) == pytest.approx(1 / 80)
    assert display.gain(picture(target=usual.target * 0)) == 1
    assert display.gain(picture(weight=0 * usual.weight)) == 1


def test_images_are_reduced_by_averages() -> None:
    image = np.random.default_rng(0).random((6, 9, 3)).astype(np.float32)
    np.testing.assert_allclose(display.averaged(image, 2, 3), image.reshape(2, 3, 3, 3, 3).mean((1, 3)), rtol=1e-5)
    np.testing.assert_allclose(display.averaged(image[..., 0], 1, 1), image[..., 0].mean(), rtol=1e-5)


@pytest.mark.parametrize(
    ("fraction", "text"),
    [
        *((0.1234, "12 %"), (0.01234, "1.2 %"), (0.5, "50 %"), (0.05, "5 %"), (1.5, "150 %"), (0.000123, "0.012 %")),
        *((0.0, "0 %"), (1e-9, "less than 0.001 %"), (50.0, "more than 1000 %"), (math.inf, "more than 1000 %")),
        *((math.nan, "unknown"), (0.0996, "10 %")),
    ],
)
def test_errors_in_words(fraction: float, text: str) -> None:
    assert display.percent(fraction) == text.replace(" %", "\u00a0%")
    assert display.percent(fraction) in display.error_words(fraction)

"""The search of single numbers without derivatives, on functions whose minima are known."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from shadowmap_dr.fitting.places import best_places

Array = npt.NDArray[np.float64]
LOW, HIGH, RANGES = np.array([-2.0, -0.2, -2.0]), np.array([2.0, 2.0, 2.0]), np.ones(3)


def waves(x: Array) -> float:
    """A function with minima all over; the least one is at (0.7, -0.6, 0)."""
    away = x - np.array([0.7, -0.6, 0.0])
    return float(1 + np.sum(away**2 + 0.5 * np.sin(8 * away) ** 2))


def test_numbers_leave_minima_of_their_own() -> None:
    begin = np.array([-0.35, 1.0, 0.4])
    x, cost = best_places(waves, begin, [0, 1], RANGES, LOW, HIGH)
    np.testing.assert_allclose(x, [0.7, -0.2, 0.4], atol=0.25 / 2**4)  # the second at its bound, the third as it was
    assert cost == waves(x) and begin.tolist() == [-0.35, 1.0, 0.4]


@pytest.mark.parametrize("numbers", [[], [0]])
def test_what_is_not_better_is_kept(numbers: list[int]) -> None:
    begin = np.array([0.7, 0.0, 0.0])
    x, cost = best_places(waves, begin, numbers, RANGES, LOW, HIGH)
    assert x.tolist() == begin.tolist() and cost == waves(begin)

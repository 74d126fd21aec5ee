"""Intervals of fits of synthetic columns, against what is known of them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from shadowmap_dr.fitting.objective import PRIOR_WEIGHT
from shadowmap_dr.fitting.uncertainty import INFLATION, PIXEL, not_told_apart, uncertainty

SIZE = 64


def of(columns: np.ndarray, noise: float = 0.01, prior: np.ndarray | None = None) -> Any:
    """The uncertainty of numbers with derivatives (n, SIZE, SIZE, 3), of residuals that are noise."""
    count, pixels = len(columns), float(SIZE**2)
    flat = columns.reshape(count, -1)
    residual = np.random.default_rng(1).normal(0, noise, (SIZE, SIZE, 3))
    precision = PRIOR_WEIGHT / (3 * pixels) / np.square(np.full(count, np.inf) if prior is None else prior)
    at = lambda x: SimpleNamespace(residuals=[residual + (x @ flat).reshape(residual.shape)])  # noqa: E731
    objective = SimpleNamespace(
        terms=3 * pixels,
        precision=precision,
        count=count,
        observations=[SimpleNamespace(brightness=1.0)],
        comparisons=[SimpleNamespace(derivatives=lambda image, changes: list(changes))],
        has_own_residuals=False,
        is_corrected=False,
        at=at,
    )
    point = SimpleNamespace(
        system=lambda: (flat @ flat.T / (3 * pixels) + np.diag(precision), None),
        columns=lambda: [flat],
        weights=lambda: [np.ones(flat.shape[1])],
        residuals=[residual],
        recorded=[np.zeros((SIZE, SIZE, 3))],
        x=np.zeros(count),
    )
    found: Any = uncertainty(point, objective)  # type: ignore[arg-type]
    return found


def patterns(count: int) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(count, SIZE, SIZE, 3))


def test_two_numbers_of_one_effect_are_not_determined_and_not_told_apart() -> None:
    a, b, c = patterns(3)
    for factor in (1.0, -2.0):
        found = of(np.stack([a, b, factor * b, c]))
        assert np.isinf(found.half_widths).tolist() == [False, True, True, False]
        assert not_told_apart(found) == [(1, 2)]
        assert found.correlations[1, 2] == pytest.approx(-np.sign(factor), abs=1e-6)


def test_three_numbers_of_two_effects_are_not_determined() -> None:
    a, b = patterns(2)
    assert np.isinf(of(np.stack([a, b, a + b])).half_widths).all()


def test_a_number_that_moves_nothing_is_idle() -> None:
    found = of(np.stack([patterns(1)[0], np.zeros((SIZE, SIZE, 3))]))
    assert found.idle.tolist() == [False, True] and np.isinf(found.half_widths).tolist() == [False, True]
    assert not_told_apart(found) == []


def test_a_small_thing_moves_something(monkeypatch: pytest.MonkeyPatch) -> None:
    """Twelve of 110,592 values that change by 0.5: less than 0.005 of the brightness over all, as a little everywhere does. One
    pixel may be one that an edge has passed."""
    monkeypatch.setitem(globals(), "SIZE", 192)
    small, single, little = np.zeros((3, 192, 192, 3))
    small[20:22, 30:32], single[20, 30], little[:] = 0.5, 0.5, 0.004
    found = of(np.stack([patterns(1)[0], small, single, little]))
    assert found.idle.tolist() == [False, False, True, True]


def test_numbers_that_are_told_apart_have_intervals_of_the_noise() -> None:
    """Noise of single pixels: the variance is that of the noise, twice, and of PIXEL, over the column's square."""
    found, count = of(patterns(3)), SIZE * SIZE * 3
    expected = 1.96 * np.sqrt(INFLATION * 0.01**2 + PIXEL**2) / np.sqrt(count)
    # Errors that all pixels share are 0.002 here: a mean of the column of 1 / sqrt(count) or so.
    np.testing.assert_allclose(found.half_widths, expected, rtol=0.35)


def test_where_only_a_prior_determines_numbers_the_interval_is_the_priors() -> None:
    a, b = patterns(2)
    found = of(np.stack([a, b, b]), prior=np.array([np.inf, 0.1, 0.1]))
    # Of two numbers whose sum is known, each has the deviation 0.1 / sqrt(2).
    np.testing.assert_allclose(found.half_widths[1:], 1.96 * 0.1 / np.sqrt(2), rtol=0.05)

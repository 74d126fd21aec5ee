"""Unit vectors: values and derivatives at lengths whose squares, or the inverses of whose third powers, no Float holds."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr.jit.vectors import direction_and_length, normalize_or, unit

LENGTHS = [1e-28, 1e-24, 1e-19, 1e-13, 1e-12, 1e-6, 1.0, 1e7, 1e18]
SHAPE, CHANGE = np.array([0.36, -0.48, 0.8]), np.array([0.5, 0.2, -0.3])


def moving(length: float) -> tuple[mi.Float, mi.Vector3f]:
    """(t, a vector of this length that moves with t by its length times CHANGE)."""
    t = dr.opaque(mi.Float, 0)
    dr.enable_grad(t)
    return t, mi.Vector3f(*(dr.opaque(mi.Float, length * s) + t * (length * c) for s, c in zip(SHAPE, CHANGE, strict=True)))


def lengthened(vector: mi.Vector3f) -> mi.Vector3f:
    direction, length, there = direction_and_length(vector)
    assert dr.all(there)
    return direction * length / dr.detach(length)


def across() -> np.ndarray:
    """Derivative of the direction."""
    return CHANGE - SHAPE * (SHAPE @ CHANGE)


@pytest.mark.parametrize("length", LENGTHS)
@pytest.mark.parametrize(
    ("function", "expected"),
    [(unit, across()), (lambda v: normalize_or(v, mi.Vector3f(0)), across()), (lengthened, CHANGE)],
    ids=["unit", "normalize_or", "direction_and_length"],
)
def test_vectors_of_any_length(
    variant: str, function: Callable[[mi.Vector3f], mi.Vector3f], expected: np.ndarray, length: float
) -> None:
    t, vector = moving(length)
    result = function(vector)
    np.testing.assert_allclose(np.array(result)[:, 0], SHAPE, rtol=1e-5)
    dr.forward(t, flags=dr.ADFlag.ClearNone)
    np.testing.assert_allclose(np.array(dr.grad(result))[:, 0], expected, rtol=1e-4, atol=1e-6)

    t, vector = moving(length)
    weights = mi.Vector3f(2, -1, 0.5)
    dr.backward(dr.dot(function(vector), weights))
    assert dr.grad(t)[0] == pytest.approx(expected @ np.array(weights)[:, 0], rel=1e-4)


@pytest.mark.parametrize("length", [0.0, 1e-40, 1e-31])
def test_vectors_without_a_direction(variant: str, length: float) -> None:
    t, vector = moving(length)
    direction, size, there = direction_and_length(vector)
    chosen = normalize_or(vector, mi.Vector3f(0, 0, 1))
    assert not dr.any(there) and np.all(np.array(direction) == 0) and size[0] == 0
    assert np.array(chosen)[:, 0].tolist() == [0, 0, 1]
    dr.backward(dr.sum(direction) + size + dr.sum(chosen))
    assert dr.grad(t)[0] == 0

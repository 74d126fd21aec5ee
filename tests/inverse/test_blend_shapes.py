"""The matrix product behind morphable models."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr.inverse import blend

ROWS, COUNT = 201, 5
RNG = np.random.default_rng(0)
REST, BASIS, WEIGHTS = (RNG.normal(size=n).astype(np.float32) for n in (ROWS, COUNT * ROWS, COUNT))
MATRIX = BASIS.reshape(COUNT, ROWS).astype(np.float64)


def test_value(variant: str) -> None:
    result = blend(mi.Float(REST), mi.Float(BASIS), mi.Float(WEIGHTS))
    np.testing.assert_allclose(np.array(result), REST + WEIGHTS @ MATRIX, atol=1e-5)


def test_backward_is_the_transpose(variant: str) -> None:
    rest, weights = mi.Float(REST), mi.Float(WEIGHTS)
    dr.enable_grad(rest, weights)
    result = blend(rest, mi.Float(BASIS), weights)
    upstream = RNG.normal(size=ROWS).astype(np.float32)
    dr.set_grad(result, mi.Float(upstream))
    dr.enqueue(dr.ADMode.Backward, result)
    dr.traverse(dr.ADMode.Backward)
    np.testing.assert_allclose(np.array(dr.grad(weights)), MATRIX @ upstream, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(np.array(dr.grad(rest)), upstream)


def test_forward_is_the_product(variant: str) -> None:
    weights = mi.Float(WEIGHTS)
    dr.enable_grad(weights)
    result = blend(mi.Float(REST), mi.Float(BASIS), weights)
    direction = RNG.normal(size=COUNT).astype(np.float32)
    dr.set_grad(weights, mi.Float(direction))
    np.testing.assert_allclose(np.array(dr.forward_to(result)), direction @ MATRIX, atol=1e-5)


def test_wrong_size(variant: str) -> None:
    with pytest.raises(ValueError, match="a basis of 1005 numbers for 201 coordinates and 4 weights; give 804"):
        blend(mi.Float(REST), mi.Float(BASIS), mi.Float(WEIGHTS[:4]))

"""Bounds of four power moments against those of `diffmoments`, the authors' implementation."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr.shadow.methods import power_moments
from shadowmap_dr.shadow.methods.power_moments import power_moments_visibility

COUNT = 4000


def mixtures(least: int, most: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Power moments (5, N) of mixtures of several depths in -1..1, receivers' depths there (N,), and shares before them (N,)."""
    rng = np.random.default_rng(least)
    number = rng.integers(least, most + 1, COUNT)
    depths = rng.uniform(-1, 1, (COUNT, most))
    weights = rng.uniform(0.05, 1, depths.shape) * (np.arange(most) < number[:, None])
    weights /= weights.sum(1, keepdims=True)
    receivers = rng.uniform(-1, 1, COUNT)
    moments = np.stack([(weights * depths**k).sum(1) for k in range(5)])
    return moments, receivers, (weights * (depths < receivers[:, None])).sum(1)


def floats(values: np.ndarray) -> Any:
    return mi.Float(np.ascontiguousarray(values, np.float32))


@pytest.mark.parametrize(("least", "most"), [(1, 2), (3, 6)])
def test_bounds_and_derivatives(variant: str, least: int, most: int) -> None:
    bounds = pytest.importorskip("diffmoments.np")
    moments, receivers, share = mixtures(least, most)
    given, depth = [floats(moment) for moment in moments[1:]], floats(0.5 * receivers)
    dr.enable_grad(given, depth)
    ours = 1 - power_moments_visibility(given, depth)
    dr.backward(dr.sum(ours))
    arguments = moments.astype(np.float32), receivers.astype(np.float32), power_moments._BIAS, 0.0
    theirs, context = bounds.compute_moment_bounds(*arguments, return_backward_context=True)
    off = np.abs(ours.numpy() - theirs)
    assert off.max() < 0.02
    assert np.quantile(off, 0.99) < 1e-3
    assert np.all(ours.numpy() < share + 1e-3)  # a lower bound
    if most < 3:
        return  # derivatives of bounds by moments of fewer than three depths are those of the bias
    by_moment, by_depth = bounds.compute_moment_bounds_backward(context, np.ones(COUNT, np.float32))
    pairs = [(given[k].grad.numpy(), by_moment[k + 1]) for k in range(4)] + [(0.5 * depth.grad.numpy(), by_depth)]
    for mine, other in pairs:
        close = np.abs(mine - other) <= 0.02 * np.abs(other) + 1e-3
        assert close.mean() > 0.97


def test_any_moments_give_finite_bounds(variant: str) -> None:
    """Also such as no distribution has, of all sizes, and their derivatives."""
    rng = np.random.default_rng(5)
    moments = rng.normal(size=(4, COUNT)) * 10 ** rng.uniform(-6, 3, (1, COUNT))
    given, depth = [floats(moment) for moment in moments], floats(rng.uniform(-0.5, 0.5, COUNT))
    dr.enable_grad(given, depth)
    found = power_moments_visibility(given, depth)
    dr.backward(dr.sum(found))
    assert np.all((found.numpy() >= 0) & (found.numpy() <= 1))
    assert all(np.isfinite(array.grad.numpy()).all() for array in (*given, depth))

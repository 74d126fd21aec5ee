"""Kernels against their formulas, convolution against SciPy, its adjoint against its forward mode."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.ndimage import correlate

from shadowmap_dr.shadow import filter_kernel, filter_map


@pytest.mark.parametrize("size", [1, 3, 5, 9, 15])
@pytest.mark.parametrize("name", ["box", "gaussian", "wendland", "none"])
@pytest.mark.parametrize("compat", [False, True])
@pytest.mark.parametrize("width", [19, 20])
def test_matches_scipy_and_is_its_own_adjoint(variant: str, name: str, size: int, compat: bool, width: int) -> None:
    rng = np.random.default_rng(size)
    maps, height, channels = 2, 17, 2
    image = rng.normal(size=(maps, height, width, channels)).astype(np.float32)
    kernel = filter_kernel(name, size, compat)
    x = mi.Float(image.ravel())
    dr.enable_grad(x)
    y = filter_map(x, kernel, maps, height, width, channels)
    want = np.stack(
        [np.stack([correlate(image[m, :, :, c], kernel, mode="nearest") for c in range(channels)], -1) for m in range(maps)]
    )
    np.testing.assert_allclose(y.numpy().reshape(want.shape), want, atol=3e-6)

    direction, weight = (rng.normal(size=image.size).astype(np.float32) for _ in range(2))
    dr.set_grad(x, mi.Float(direction))
    dr.forward_to(y, flags=dr.ADFlag.Default & ~dr.ADFlag.ClearEdges)
    forward = float((dr.grad(y).numpy() * weight).sum())
    dr.clear_grad((x, y))
    dr.backward(dr.sum(y * mi.Float(weight)))
    backward = float((dr.grad(x).numpy() * direction).sum())
    assert abs(forward - backward) < 1e-4 * np.linalg.norm(direction) * np.linalg.norm(weight) / 10


def test_formulas() -> None:
    line = np.exp(-0.5 * (np.arange(-2, 3) / 1.25) ** 2)
    np.testing.assert_allclose(filter_kernel("gaussian", 5), np.outer(line, line) / line.sum() ** 2)
    x, y = np.meshgrid([-1, 0, 1], [-1, 0, 1])
    gauss = np.exp(-(x**2 + y**2) / 0.2)
    np.testing.assert_allclose(filter_kernel("gaussian", 3, compat=True), gauss / gauss.sum())
    grid = np.linspace(-1, 1, 5)
    d = np.minimum(np.hypot(*np.meshgrid(grid, grid)), 1)
    wendland = (1 - d) ** 4 * (4 * d + 1)
    np.testing.assert_allclose(filter_kernel("wendland", 5, compat=True), wendland / wendland.sum())
    np.testing.assert_allclose(filter_kernel("box", 3), np.full((3, 3), 1 / 9))


@pytest.mark.parametrize(("name", "size"), [("mean", 3), ("box", 2), ("box", 0), ("box", -3)])
def test_bad_filters_are_named(name: str, size: int) -> None:
    with pytest.raises(ValueError, match=name if name == "mean" else str(size)):
        filter_kernel(name, size)

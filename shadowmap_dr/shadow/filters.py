"""Pre-filters of shadow maps: kernels and their exact, atomics-free convolution."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from ..raster._types import backend

FILTERS = ("box", "gaussian", "wendland", "none")


def filter_kernel(name: str, size: int, compat: bool = False) -> np.ndarray:
    """Weights (size, size), float64, summing to 1.

    - ``box``: equal weights.
    - ``gaussian``: standard deviation of size / 4 texels.
    - ``wendland``: product of (1 - d)^4 (4 d + 1) along both axes with d = distance / ((size + 1) / 2).
    - ``none``: the identity, whatever the size.

    ``compat`` samples the authors' kernels on a size x size grid over [-1, 1]^2 instead: exp(-(x^2 + y^2) / 0.2), and the
    Wendland function of the radius (0 beyond 1). At size 3 these are nearly the identity.

    Raises:
        ValueError: unknown name, or a size that is not odd and positive.
    """
    if name not in FILTERS:
        raise ValueError(f"shadow filter {name!r} is unknown; choose one of {', '.join(FILTERS)}")
    if size != int(size) or size < 1 or size % 2 == 0:
        raise ValueError(f"shadow filter size is {size}; it must be an odd number of texels, at least 1")
    if name == "none" or size == 1:
        return np.ones((1, 1))
    offset = np.arange(size) - size // 2
    if name == "box":
        kernel = np.ones((size, size))
    elif compat:
        grid = np.linspace(-1, 1, size)
        square = grid[:, None] ** 2 + grid**2
        kernel = np.exp(-square / 0.2) if name == "gaussian" else _wendland(np.sqrt(square))
    else:
        line = np.exp(-0.5 * (offset / (size / 4)) ** 2) if name == "gaussian" else _wendland(np.abs(offset) / ((size + 1) / 2))
        kernel = line[:, None] * line
    return kernel / kernel.sum()


def _wendland(d: np.ndarray) -> np.ndarray:
    d = np.minimum(d, 1)
    return (1 - d) ** 4 * (4 * d + 1)


def separable_terms(kernel: np.ndarray) -> list[tuple[list[float], list[float]]]:
    """Write a kernel as a sum of (column, row) outer products; one term for a separable kernel, a few for a radial one."""
    u, s, v = np.linalg.svd(kernel)
    keep = s > 1e-7 * s[0]
    return [((u[:, k] * s[k]).tolist(), v[k].tolist()) for k in np.nonzero(keep)[0]]


def filter_map(values: Any, kernel: np.ndarray, maps: int, height: int, width: int, channels: int) -> Any:
    """Convolve maps with a kernel; the border is replicated.

    Args:
        values: flat ``Float`` (maps * height * width * channels), channels interleaved; 1, 2 or a multiple of 4 channels.
        kernel: (k, k) weights, k odd.

    Gradients flow to ``values``. Exact adjoint by gathering, without atomics.
    """
    if kernel.size == 1:
        return values if kernel.item() == 1 else values * kernel.item()
    total = None
    for column, row in separable_terms(kernel):
        part = dr.custom(_Convolve, values, row, 1, (maps, height, width, channels))
        part = dr.custom(_Convolve, part, column, 0, (maps, height, width, channels))
        total = part if total is None else total + part
    return total


class _Convolve(dr.CustomOp):
    """Convolution along one axis (0: rows, 1: columns) with a replicated border; its transpose as the backward pass."""

    def eval(self, values: Any, weights: list[float], axis: int, shape: tuple[int, int, int, int]) -> Any:
        self.arguments = (weights, axis, shape)
        return _convolve(values, *self.arguments, transpose=False)

    def forward(self) -> None:
        self.set_grad_out(_convolve(self.grad_in("values"), *self.arguments, transpose=False))

    def backward(self) -> None:
        self.set_grad_in("values", _convolve(self.grad_out(), *self.arguments, transpose=True))


def _convolve(values: Any, weights: list[float], axis: int, shape: tuple[int, int, int, int], transpose: bool) -> Any:
    maps, height, width, channels = shape
    if axis == 0 and width * channels % 4 == 0:
        # What lies side by side is treated alike: columns in packets of four numbers.
        width, channels = width * channels // 4, 4
    module = backend(values)
    # Texels of many numbers are several packets, that is, several lanes.
    parts = max(1, channels // 4)
    channels //= parts
    packet = {1: module.Float, 2: module.Array2f, 4: module.Array4f}[channels]
    n, stride = (height, width) if axis == 0 else (width, parts)
    radius = len(weights) // 2
    lane = dr.arange(module.UInt32, maps * height * width * parts)
    at = module.Int32((lane // stride) % n)
    dr.eval(values)
    total = dr.zeros(packet)
    for k in range(-radius, radius + 1):
        source = at - k if transpose else at + k
        inside = (source >= 0) & (source < n)
        clamped = dr.clip(source, 0, n - 1)
        index = module.UInt32(module.Int32(lane) + (clamped - at) * stride)
        weight = module.Float(weights[k + radius])
        if transpose:
            # Border lanes also receive what taps beyond the border read from them.
            weight = dr.select(inside, weight, 0)
            for j in range(-radius, radius + 1):
                w = weights[j + radius]
                weight += dr.select(inside & (at == 0) & (source + j < 0), w, 0)
                weight += dr.select(inside & (at == n - 1) & (source + j > n - 1), w, 0)
        total += dr.gather(packet, values, index) * weight
    return total if channels == 1 else dr.ravel(total)

"""Pre-filters of shadow maps: kernels and their exact, atomics-free convolution."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import drjit as dr
import numpy as np

from ..jit.arrays import backend, ravel
from ..jit.handover import computed
from ..jit.kernel_inputs import SharingOp, int_input, quotient, split
from ..jit.types import AnyArray, Float, Int32

FILTERS = ("box", "gaussian", "wendland", "none")


def reach_of(filter_size: int) -> float:
    """Largest distance (texels) between a point and a texel that its look-up reads, by filter and interpolation."""
    return 0.5 * filter_size + 1


def filter_kernel(name: str, size: int, compat: bool = False) -> np.ndarray:
    """Weights (size, size), float64, summing to 1.

    - ``box``: equal weights.
    - ``gaussian``: standard deviation of size / 4 texels.
    - ``wendland``: product of (1 - d)^4 (4 d + 1) along both axes with d = distance / ((size + 1) / 2).
    - ``none``: the identity, whatever the size.

    ``compat`` samples Worchel and Alexa's kernels on a size x size grid over [-1, 1]^2 instead: exp(-(x^2 + y^2) / 0.2), and
    the Wendland function of the radius (0 beyond 1). At size 3 these are nearly the identity.

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
    """Terms (column, row) whose outer products sum to a kernel: one for a separable kernel, a few for a radial one."""
    u, s, v = np.linalg.svd(kernel)
    keep = s > 1e-7 * s[0]
    return [((u[:, k] * s[k]).tolist(), v[k].tolist()) for k in np.nonzero(keep)[0]]


def filter_map(values: Float, kernel: np.ndarray, maps: int, height: int, width: int, channels: int) -> Float:
    """Convolve maps with a kernel; the border is replicated.

    Args:
        values: flat ``Float`` (maps * height * width * channels), channels interleaved; 1, 2 or a multiple of 4 channels.
        kernel: (k, k) weights, k odd.

    Gradients flow to ``values``. Exact adjoint by gathering, without atomics.
    """
    if kernel.size == 1:
        return values if kernel.item() == 1 else values * kernel.item()

    def convolved(column: list[float], row: list[float]) -> Float:
        part = dr.custom(_Convolve, values, row, 1, (maps, height, width, channels))
        return dr.custom(_Convolve, part, column, 0, (maps, height, width, channels))

    first, *others = separable_terms(kernel)
    total = convolved(*first)
    for term in others:
        total = total + convolved(*term)
    return total


class _Convolve(SharingOp):
    """Convolution along one axis (0: rows, 1: columns) with a replicated border; its transpose as the backward pass."""

    def eval(self, values: Float, weights: list[float], axis: int, shape: tuple[int, int, int, int]) -> Float:
        self.arguments = (weights, axis, shape)
        return computed("filtered maps", lambda: _convolve(values, *self.arguments, transpose=False))

    def forward(self) -> None:
        self.set_grad_out(_convolve(cast("Float", self.grad_in("values")), *self.arguments, transpose=False))

    def backward(self) -> None:
        self.set_grad_in("values", _convolve(cast("Float", self.grad_out()), *self.arguments, transpose=True))


def _convolve(values: Float, weights: list[float], axis: int, shape: tuple[int, int, int, int], transpose: bool) -> Float:
    maps, height, width, channels = shape
    if axis == 0 and width * channels % 4 == 0:
        # Neighbours in a row have the same taps: process columns in packets of four numbers.
        width, channels = width * channels // 4, 4
    dr.eval(values)
    if axis == 1 and channels == 2 and width % 2 == 0:
        return _convolve_pairs(values, weights, maps * height, width, transpose)
    module = backend(values)
    # Texels of more than four numbers are several packets, one lane each.
    parts = max(1, channels // 4)
    channels //= parts
    packet = {1: module.Float, 2: module.Array2f, 4: module.Array4f}[channels]
    n, stride = (height, width) if axis == 0 else (width, parts)
    lane = dr.arange(module.UInt32, maps * height * width * parts)
    # Rows above each other, or the packets of a texel: both are strides to the neighbours on the axis.
    _, place = split(quotient(lane, "stride", stride), "length", n, dr.width(lane) // (stride * n))
    at, step = module.Int32(place), int_input(module, "stride", stride)
    last = int_input(module, "length", n - 1)

    def read(k: int) -> AnyArray:
        clamped = dr.clip(at + k, 0, last)
        return dr.gather(packet, values, module.UInt32(module.Int32(lane) + (clamped - at) * step))

    total = _weighted(read, at, n, weights, transpose)
    return cast("Float", total) if channels == 1 else ravel(total)


def _convolve_pairs(values: Float, weights: list[float], rows: int, width: int, transpose: bool) -> Float:
    """Convolve rows of two-channel texels, two texels a lane, which share their reads."""
    module = backend(values)
    Int32, UInt32 = module.Int32, module.UInt32
    lane = dr.arange(UInt32, rows * width // 2)
    _, pair = split(lane, "pairs", width // 2, rows)
    at, last = Int32(2 * pair), int_input(module, "length", width - 1)
    own = dr.gather(module.Array4f, values, lane)
    texels = {0: module.Array2f(own.x, own.y), 1: module.Array2f(own.z, own.w)}

    def read(k: int) -> AnyArray:
        """The texel k columns from the first of the lane's two texels."""
        if k not in texels:
            texels[k] = dr.gather(module.Array2f, values, UInt32(2 * Int32(lane) + (dr.clip(at + k, 0, last) - at)))
        return texels[k]

    first = _weighted(read, at, width, weights, transpose)
    second = _weighted(lambda k: read(k + 1), at + 1, width, weights, transpose)
    return ravel(module.Array4f(*first, *second))


def _weighted(read: Callable[[int], AnyArray], at: Int32, n: int, weights: list[float], transpose: bool) -> AnyArray:
    """Sum over the taps. ``read(k)``: texels k places from ``at`` (0 to n - 1), clamped to the border."""
    module = backend(at)
    radius = len(weights) // 2
    size = int_input(module, "length", n)

    def tap(k: int) -> AnyArray:
        weight = module.Float(weights[k + radius])
        if transpose:
            # The forward pass reads border texels for taps beyond the border: the adjoints of these taps go to border lanes.
            source = at - k
            inside = (source >= 0) & (source < size)
            weight = dr.select(inside, weight, 0)
            for j in range(-radius, radius + 1):
                w = weights[j + radius]
                weight += dr.select(inside & (at == 0) & (source + j < 0), w, 0)
                weight += dr.select(inside & (at == size - 1) & (source + j > size - 1), w, 0)
        return read(-k if transpose else k) * weight

    total = tap(-radius)
    for k in range(-radius + 1, radius + 1):
        total = total + tap(k)
    return total

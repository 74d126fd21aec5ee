"""Gaussian blur of images on the device. Its width may change from step to step of a recorded function."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..jit.types import Float, Int32

# Taps of a wide Gaussian: one for each eighth of its largest standard deviation, to three of them on both sides.
_TAPS_PER_WIDTH = 8
_REACH = 3


def blurred(values: Float, shape: tuple[int, ...], width: Float, most: float) -> Float:
    """An image convolved with a Gaussian.

    Args:
        values: Float (H W C), the image row by row, zero outside.
        shape: (H, W, C).
        width: Float (1,), standard deviation in pixels; the image stays as it is at 0.
        most: largest width. It determines the number of taps: wide Gaussians sample an image that a narrow one has blurred.

    Returns Float (H W C). No gradients: the blur is its own adjoint, up to the image's border.
    """
    height, columns, channels = shape
    spread = max(1, int(most) // _TAPS_PER_WIDTH)
    # Squares of widths add up.
    narrow = dr.minimum(width, 0.75 * spread)
    wide = dr.safe_sqrt(dr.square(width) - dr.square(narrow)) if spread > 1 else width
    for stride, count in ((channels, columns), (channels * columns, height)):
        if spread > 1:
            values = _convolved(values, stride, count, narrow, 1, _REACH * spread)
        values = _convolved(values, stride, count, wide, spread, int(_REACH * most / spread) + 1)
    return values


def _convolved(values: Float, stride: int, count: int, width: Float, spread: int, taps: int) -> Float:
    """An image convolved along one axis, with ``taps`` samples on both sides that are ``spread`` pixels apart."""
    index = dr.arange(mi.Int32, dr.width(values))
    place = index // stride % count
    exponent = -0.5 / dr.square(dr.maximum(width, 1e-3))

    def add(k: Int32, total: Float, weights: Float) -> tuple[Int32, Float, Float]:
        offset = k * spread
        weight = dr.exp(dr.square(mi.Float(offset)) * exponent)
        inside = (place + offset >= 0) & (place + offset < count)
        value = dr.gather(mi.Float, values, mi.UInt32(index + offset * stride), inside)
        return k + 1, total + weight * value, weights + weight

    begin = mi.Int32(-taps), dr.zeros(mi.Float, dr.width(values)), mi.Float(0)
    _, total, weights = dr.while_loop(begin, lambda k, *_: k <= taps, add)
    result = total / weights
    dr.eval(result)
    return result

"""Gaussian blur of images on the device. Its width may change from step to step of a recorded function."""

from __future__ import annotations

from typing import cast

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
    # Colours are gathered together.
    together = 3 if channels == 3 else 1
    step = channels // together
    spread = max(1, int(most) // _TAPS_PER_WIDTH)
    # Squares of widths add up.
    narrow = dr.minimum(width, 0.75 * spread)
    wide = dr.safe_sqrt(dr.square(width) - dr.square(narrow)) if spread > 1 else width
    for stride, count in ((step, columns), (step * columns, height)):
        if spread > 1:
            values = _convolved(values, together, stride, count, narrow, 1, _REACH * spread)
        values = _convolved(values, together, stride, count, wide, spread, int(_REACH * most / spread) + 1)
    return values


def _convolved(values: Float, together: int, stride: int, count: int, width: Float, spread: int, taps: int) -> Float:
    """An image convolved along one axis, with at most ``taps`` samples on both sides that are ``spread`` pixels apart.

    ``together``: neighbouring values with the same neighbours, 1 or 3. ``stride``, ``count``: of the axis, in groups of them.
    """
    kind = cast(type[Float], mi.Vector3f if together == 3 else mi.Float)
    size = dr.width(values) // together
    index = dr.arange(mi.Int32, size)
    place = index // stride % count
    exponent = -0.5 / dr.square(dr.maximum(width, 1e-3))

    def add(k: Int32, total: Float, weights: Float) -> tuple[Int32, Float, Float]:
        offset = k * spread
        weight = dr.exp(dr.square(mi.Float(offset)) * exponent)
        inside = (place + offset >= 0) & (place + offset < count)
        value = dr.gather(kind, values, mi.UInt32(index + offset * stride), inside)
        return k + 1, total + weight * value, weights + weight

    # As many as the present width needs: none beside the pixel without blur.
    last = mi.Int32(dr.minimum(float(taps), dr.ceil(_REACH * width / spread)))
    begin = -last, dr.zeros(kind, size), mi.Float(0)
    _, total, weights = dr.while_loop(begin, lambda k, *_: k <= last, add)
    result = dr.ravel(total / weights)
    dr.eval(result)
    return cast(Float, result)

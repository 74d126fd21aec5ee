"""Weights with which the neighbours of a pixel reach into it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import cast

import drjit as dr

from ...jit.arrays import backend
from ...jit.kernel_inputs import uint_input
from ...jit.types import Float, UInt32
from .edge_crossings import Crossings


def incoming_weights(crossings: Crossings, width: int) -> tuple[Float, Float, Float, Float]:
    """Weights with which the right, lower, left and upper neighbour each reach into a pixel of images ``width`` pixels wide."""
    return around(crossings.right, crossings.down, width, 1)


def around(
    right: Float, down: Float, width: int, sign: int, signed: bool = False, at: UInt32 | None = None
) -> tuple[Float, Float, Float, Float]:
    """Weights of the right, lower, left and upper neighbour in a pixel, or (``sign`` -1) of the pixel in each neighbour.

    Pairs that reach beyond the image have weight 0. So have the pairs of a row's last pixel with the next row's first one, and
    of the last row with the first row of the next image.

    Args:
        right, down: see :class:`Crossings`.
        signed: return negative weights, too, instead of 0.
        at: pixels; None for all.
    """
    module = backend(right)
    pixel = dr.arange(module.UInt32, dr.width(right)) if at is None else at
    left = dr.gather(module.Float, right, pixel - 1, pixel >= 1)
    columns = uint_input(module, "width", width)
    up = dr.gather(module.Float, down, pixel - columns, pixel >= columns)
    if at is not None:
        right, down = (dr.gather(module.Float, weights, at) for weights in (right, down))
    values = (-sign * right, -sign * down, sign * left, sign * up)
    if signed:
        return values
    right, down, left, up = (dr.maximum(v, 0) for v in values)
    return right, down, left, up


def neighbours(pixel: UInt32, width: int) -> tuple[UInt32, UInt32, UInt32, UInt32]:
    """Indices of the right, lower, left and upper neighbours of pixels in images ``width`` pixels wide."""
    columns = uint_input(backend(pixel), "width", width)
    return pixel + 1, pixel + columns, pixel - 1, pixel - columns


def weight_sum(weights: Iterable[Float]) -> Float:
    """Sum of at least one weight."""
    return cast("Float", sum(weights))

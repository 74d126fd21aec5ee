"""Depth comparison: `standard` and `pcf` shadow maps."""

from __future__ import annotations

import drjit as dr

from ...jit.arrays import backend
from ...jit.types import Float, Vector2f

# Means that differ by less from the depth at the centre of a texel are equal to it: a few units in the last place.
_LEAST_DIFFERENCE = 1e-6


def standard_visibility(map_depth: Float, depth: Float, bias: float) -> Float:
    """1 where a receiver lies at most ``bias`` behind the depth in the map, else 0 (Williams 1978). No gradients."""
    return dr.select(dr.detach(depth) <= dr.detach(map_depth) + bias, backend(depth).Float(1), 0)


def soft_comparison(map_depth: Float, depth: Float, bias: float, softness: float) -> Float:
    """1 where a receiver lies at most ``bias`` behind the depth in the map, falling to 0 within ``softness``. Attached."""
    return 1 - dr.clip((depth - map_depth - bias) / softness, 0, 1)


def other_depth(depth: Float, moments: Vector2f) -> tuple[Float, Float]:
    """Depth of the second surface in a texel that sees two, nearer or farther than the one at its centre. Attached to both.

    Args:
        depth: linear depth at the centre of the texel, in -1/2..1/2.
        moments: mean and mean square of the depth over the texel.

    Returns:
        (the other surface's depth in -1/2..1/2, the share of the texel that it covers in 0..1), such that both surfaces together
        have these moments; (``depth``, 0) where there is no other surface. Finite, also in derivatives, for any arguments.
    """
    mean = moments.x - depth
    square = dr.fma(-2 * moments.x + depth, depth, moments.y)
    # No distribution has a mean square below the squared mean; a smaller value is due to rounding.
    least = mean * mean
    square = dr.select(square > least, square, least)
    there = dr.abs(mean) > _LEAST_DIFFERENCE
    mean, square = dr.select(there, mean, 1), dr.select(there, square, 1)
    other = depth + dr.select(there, square / mean, 0)
    before = other < -0.5
    nearest = dr.select(other > 0.5, 0.5, other)
    other = dr.select(before, -0.5, nearest)
    return other, dr.select(there, mean * mean / square, 0)

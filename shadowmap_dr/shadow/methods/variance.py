"""Variance shadow maps: two moments of depth, and Chebyshev's bound.

Depths are linear in -1/2..1/2 over the range of a map. All visibilities lie in 0..1 and are finite, with finite derivatives,
for any stored numbers.
"""

from __future__ import annotations

import drjit as dr

from ...jit.arrays import backend
from ...jit.types import Float, Vector2f

#: Smallest variance that Chebyshev's bound uses, in units of the squared depth range.
MINIMUM_VARIANCE = 1e-6
#: The authors' value, for their unnormalised depths.
MINIMUM_VARIANCE_COMPAT = 1e-4


def variance_moments(depth: Float, slope_square: Float | float = 0) -> Vector2f:
    """First and second moment of the depth within a texel.

    Args:
        depth: linear depth in -1/2..1/2. Attached.
        slope_square: squared change of depth across a texel; a quarter of it, detached, is the variance of a plane within
            the texel (Lauritzen, "Summed-Area Variance Shadow Maps", GPU Gems 3, 2007, section 8.4.2).
    """
    return backend(depth).Array2f(depth, dr.fma(depth, depth, 0.25 * dr.detach(slope_square)))


def chebyshev_visibility(moments: Vector2f, depth: Float, minimum_variance: Float | float = MINIMUM_VARIANCE) -> Float:
    """Upper bound of the fraction of occluders behind ``depth``.

    Source: Donnelly and Lauritzen, "Variance Shadow Maps", 2006, equation 5.

    Args:
        moments: filtered moments. Attached.
        depth: depth of the receiver in the units of the moments. Attached.
        minimum_variance: in squared units of the moments.

    Returns:
        1 where ``depth <= mean``, else ``s2 / (s2 + (depth - mean)^2)`` with ``s2 = max(m2 - mean^2, minimum_variance)``.
    """
    mean = moments.x
    # Two branches instead of dr.maximum, which passes NaN and would give both sides half a gradient at equality.
    spread = dr.fma(-mean, mean, moments.y)
    variance = dr.select(spread > minimum_variance, spread, minimum_variance)
    distance = depth - mean
    lit = ~(distance > 0)
    distance = dr.select(lit, 0, distance)
    return dr.select(lit, 1, variance / dr.fma(distance, distance, variance))


def reduced_bleeding(visibility: Float, amount: float) -> Float:
    """Cut off visibilities below ``amount`` and stretch the rest to 0..1 (Lauritzen 2007, section 8.4.3). Attached."""
    if amount == 0:
        return visibility
    return dr.select(visibility > amount, (visibility - amount) / (1 - amount), 0)

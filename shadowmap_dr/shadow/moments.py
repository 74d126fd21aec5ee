"""What a shadow map stores and how that turns into visibility: depth comparison, variance and exponential variance maps.

Depths are linear in -1/2..1/2 over the range of a map. All visibilities lie in 0..1 and are finite, with finite derivatives,
whatever filters may make of the numbers that are stored.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from ..raster._types import backend

#: Smallest variance that Chebyshev's bound uses, in units of the squared depth range.
MINIMUM_VARIANCE = 1e-6
#: The same for warped depths, to first order: with less, surfaces that the light hardly strikes would shadow themselves.
MINIMUM_WARPED_VARIANCE = 1e-5
#: The authors' value, for their unnormalised depths.
MINIMUM_VARIANCE_COMPAT = 1e-4
# Means that differ by less from the depth at the centre of a texel are equal to it: a few units in the last place.
_LEAST_DIFFERENCE = 1e-6


def variance_moments(depth: Any, slope_square: Any = 0) -> Any:
    """First and second moment (``Array2f``) of the depth within a texel.

    Args:
        depth: linear depth in -1/2..1/2. Attached.
        slope_square: squared change of depth across a texel; a quarter of it, detached, is the variance of a plane within
            the texel (Lauritzen, "Summed-Area Variance Shadow Maps", GPU Gems 3, 2007, section 8.4.2).
    """
    return backend(depth).Array2f(depth, dr.fma(depth, depth, 0.25 * dr.detach(slope_square)))


def chebyshev_visibility(moments: Any, depth: Any, minimum_variance: Any = MINIMUM_VARIANCE) -> Any:
    """Upper bound of the fraction of occluders behind ``depth``.

    Source: Donnelly and Lauritzen, "Variance Shadow Maps", 2006, equation 5.

    Args:
        moments: ``Array2f``, filtered. Attached.
        depth: depth of the receiver in the units of the moments. Attached.
        minimum_variance: number or ``Float``.

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


def standard_visibility(map_depth: Any, depth: Any, bias: float) -> Any:
    """1 where a receiver lies at most ``bias`` behind the depth in the map, else 0 (Williams 1978). No gradients."""
    return dr.select(dr.detach(depth) <= dr.detach(map_depth) + bias, backend(depth).Float(1), 0)


def soft_comparison(map_depth: Any, depth: Any, bias: float, softness: float) -> Any:
    """1 where a receiver lies at most ``bias`` behind the depth in the map, falling to 0 over the next ``softness``. Attached."""
    return 1 - dr.clip((depth - map_depth - bias) / softness, 0, 1)


def other_depth(depth: Any, moments: Any) -> tuple[Any, Any]:
    """What a texel with two surfaces sees beside the nearer or farther one at its centre. Attached to both arguments.

    Args:
        depth: linear depth at the centre of the texel, in -1/2..1/2.
        moments: ``Array2f``, mean and mean square of the depth over the texel.

    Returns:
        (the other surface's depth in -1/2..1/2, the share of the texel that it covers in 0..1), such that both surfaces together
        have these moments; (``depth``, 0) where there is no other surface. Finite, also in derivatives, for any arguments.
    """
    mean = moments.x - depth
    square = dr.fma(-2 * moments.x + depth, depth, moments.y)
    # No distribution has a mean square below the squared mean: what is left of it is rounding.
    least = mean * mean
    square = dr.select(square > least, square, least)
    there = dr.abs(mean) > _LEAST_DIFFERENCE
    mean, square = dr.select(there, mean, 1), dr.select(there, square, 1)
    other = depth + dr.select(there, square / mean, 0)
    other = dr.select(other < -0.5, -0.5, dr.select(other > 0.5, 0.5, other))
    return other, dr.select(there, mean * mean / square, 0)


def reduced_bleeding(visibility: Any, amount: float) -> Any:
    """Cut off visibilities below ``amount`` and stretch the rest to 0..1 (Lauritzen 2007, section 8.4.3). Attached."""
    if amount == 0:
        return visibility
    return dr.select(visibility > amount, (visibility - amount) / (1 - amount), 0)


def exponential_moment(depth: Any, exponent: float) -> Any:
    """``exp(exponent * depth)``: what an exponential shadow map stores. Attached.

    Source: Annen et al., "Exponential Shadow Maps", 2008, equation 4.
    """
    return dr.exp(exponent * depth)


def exponential_visibility(moment: Any, depth: Any, exponent: float) -> Any:
    """``min(1, moment * exp(-exponent * depth))`` (Annen et al. 2008, equation 5). Attached."""
    value = moment * dr.exp(-exponent * depth)
    return dr.select(value < 1, dr.select(value > 0, value, 0), 1)


def warped_moments(depth: Any, slope_square: Any, exponent: float) -> Any:
    """First and second moment (``Array2f``) of ``sign(exponent) * exp(exponent * depth)``, which grows with depth. Attached.

    Source: Lauritzen and McCool, "Layered Variance Shadow Maps", 2008, section 4.2. A plane's variance within the texel is
    carried over to first order, detached.
    """
    warped = _warp(depth, exponent)
    slope = dr.detach(exponent * warped)
    return backend(depth).Array2f(warped, dr.fma(warped, warped, 0.25 * dr.detach(slope_square) * slope * slope))


def warped_visibility(moments: Any, depth: Any, exponent: float) -> Any:
    """Chebyshev's bound for warped depths. Attached to moments and depth."""
    warped = _warp(depth, exponent)
    # Moments span many orders of magnitude: everything is scaled by the receiver's own warped depth.
    scale = dr.rcp(dr.detach(dr.abs(warped)))
    relative = backend(depth).Array2f(moments.x * scale, moments.y * scale * scale)
    return chebyshev_visibility(relative, warped * scale, MINIMUM_WARPED_VARIANCE * exponent * exponent)


def _warp(depth: Any, exponent: float) -> Any:
    return dr.exp(exponent * depth) if exponent > 0 else -dr.exp(exponent * depth)

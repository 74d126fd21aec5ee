"""Exponential and exponential variance shadow maps: `esm`, `evsm2`, `evsm4`."""

from __future__ import annotations

import drjit as dr

from ...jit.arrays import backend
from ...jit.types import Float, Vector2f
from .variance import chebyshev_visibility

# Smallest variance relative to the squared warped depth that single precision can tell.
_PRECISE = 1e-6


def exponential_moment(depth: Float, exponent: float) -> Float:
    """``exp(exponent * depth)``, the number that an exponential shadow map stores. Attached.

    Source: Annen et al., "Exponential Shadow Maps", 2008, equation 4.
    """
    return dr.exp(exponent * depth)


def exponential_visibility(moment: Float, depth: Float, exponent: float) -> Float:
    """``min(1, moment * exp(-exponent * depth))`` (Annen et al. 2008, equation 5). Attached."""
    value = moment * dr.exp(-exponent * depth)
    dark = value < 1
    positive = dr.select(value > 0, value, 0)
    return dr.select(dark, positive, 1)


def warped_moments(depth: Float, slope_square: Float | float, exponent: Float | float, sign: int = 1) -> Vector2f:
    """First and second moment of ``sign * exp(sign * exponent * depth)``, which grows with depth. Attached.

    Source: Lauritzen and McCool, "Layered Variance Shadow Maps", 2008, section 4.2. A plane's variance within the texel is
    carried over to first order, detached.
    """
    warped = _warp(depth, exponent, sign)
    slope = dr.detach(exponent * warped)
    return backend(depth).Array2f(warped, dr.fma(warped, warped, 0.25 * dr.detach(slope_square) * slope * slope))


def warped_visibility(
    moments: Vector2f, depth: Float, exponent: Float | float, least_deviation: Float | float, sign: int = 1
) -> Float:
    """Chebyshev's bound for warped depths. Attached to moments and depth.

    ``least_deviation``: see :class:`DepthScale`; the others are those of :func:`warped_moments`.
    """
    warped = _warp(depth, exponent, sign)
    # Moments span many orders of magnitude: everything is scaled by the receiver's own warped depth.
    scale = dr.rcp(dr.detach(dr.abs(warped)))
    relative = backend(depth).Array2f(moments.x * scale, moments.y * scale * scale)
    deviation = exponent * backend(depth).Float(least_deviation)
    return chebyshev_visibility(relative, warped * scale, dr.maximum(deviation * deviation, _PRECISE))


def _warp(depth: Float, exponent: Float | float, sign: int) -> Float:
    warped = dr.exp(sign * exponent * depth)
    return warped if sign > 0 else -warped

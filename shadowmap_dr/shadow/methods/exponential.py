"""Exponential and exponential variance shadow maps: `esm`, `evsm2`, `evsm4`."""

from __future__ import annotations

from typing import Any

import drjit as dr

from ...jit.arrays import backend
from .variance import chebyshev_visibility

#: The same for warped depths, to first order: with less, surfaces that the light hardly strikes would shadow themselves.
MINIMUM_WARPED_VARIANCE = 1e-5


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

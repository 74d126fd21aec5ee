"""Moment shadow maps: four power moments, and the sharpest lower bound of the shadow that agrees with them.

Source: Peters and Klein, "Moment Shadow Mapping", 2015, algorithm 4 (Hamburger moment problem).
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from ..raster._types import backend

# How far moments are moved towards those of a distribution far from all degenerate ones, so that rounding is harmless.
_BIAS = 3e-6
_NEUTRAL = (0.0, 0.375, 0.0, 0.375)
_TINY = 1e-9


def power_moments(depth: Any, slope_square: Any) -> list[Any]:
    """The first four moments of twice the depth (-1..1), normally distributed with a plane's variance in the texel. Attached."""
    z = 2 * depth
    # Depths are doubled, variances quadrupled.
    v = dr.detach(slope_square)
    square = z * z
    return [z, square + v, z * (square + 3 * v), square * square + 6 * square * v + 3 * v * v]


def hamburger_visibility(moments: list[Any], depth: Any) -> Any:
    """1 minus the least fraction of occluders before ``depth`` that the moments allow. Attached."""
    Float = backend(depth).Float
    b = [dr.fma(_BIAS, neutral - m, m) for m, neutral in zip(moments, _NEUTRAL, strict=True)]
    z = 2 * depth
    # Cholesky factorisation of the Hankel matrix ((1, b0, b1), (b0, b1, b2), (b1, b2, b3)), solved for (1, z, z^2).
    d22 = _at_least(dr.fma(-b[0], b[0], b[1]), _TINY)
    l32_d22 = dr.fma(-b[0], b[1], b[2])
    d33_d22 = dr.fma(dr.fma(-b[1], b[1], b[3]), d22, -l32_d22 * l32_d22)
    d33 = _at_least(d33_d22 / d22, _TINY)
    l32 = l32_d22 / d22
    y1 = z - b[0]
    y2 = dr.fma(-l32, y1, z * z - b[1])
    c2 = y2 / d33
    c1 = dr.fma(-l32, c2, y1 / d22)
    c0 = 1 - b[0] * c1 - b[1] * c2
    # The other two points of support are the roots of c0 + c1 x + c2 x^2.
    c2 = dr.select(dr.abs(c2) < _TINY, dr.select(c2 < 0, Float(-_TINY), Float(_TINY)), c2)
    p, q = 0.5 * c1 / c2, c0 / c2
    r = dr.sqrt(_at_least(dr.fma(p, p, -q), _TINY))
    low, high = -p - r, -p + r

    def mass_below(x: Any, y: Any, other: Any) -> Any:
        """Weight of the support point ``other`` among x, y and itself."""
        return dr.fma(x, y, -b[0] * (x + y)) + b[1], _away_from_zero((other - x) * (other - y))

    # z lies below both roots: nothing before it; between them: the lower root's weight; above: all but its own.
    above, above_scale = mass_below(low, high, z)
    between, between_scale = mass_below(z, high, low)
    shadow = dr.select(z > high, 1 - above / above_scale, dr.select(z > low, between / between_scale, 0))
    shadow = dr.select(dr.isfinite(shadow), shadow, 0)
    return 1 - dr.clip(shadow, 0, 1)


def _at_least(value: Any, least: float) -> Any:
    return dr.select(value > least, value, least)


def _away_from_zero(value: Any) -> Any:
    Float = type(value)
    return dr.select(dr.abs(value) < _TINY, dr.select(value < 0, Float(-_TINY), Float(_TINY)), value)

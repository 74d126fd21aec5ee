"""Moment shadow maps: four power moments, and the sharpest lower bound of the shadow that agrees with them.

Source: Peters and Klein, "Moment Shadow Mapping", 2015, algorithm 4 (Hamburger moment problem).
"""

from __future__ import annotations

import drjit as dr

from ...jit.types import Float

# Fraction by which moments are moved towards those of a non-degenerate distribution, so that rounding is harmless.
_BIAS = 3e-6
_NEUTRAL = (0.0, 0.375, 0.0, 0.375)
_TINY = 1e-9


def power_moments(depth: Float, slope_square: Float | float) -> list[Float]:
    """The first four moments of twice the depth (-1..1), normally distributed with a plane's variance in the texel. Attached."""
    z = 2 * depth
    # Depths are doubled, variances quadrupled.
    v = dr.detach(slope_square)
    square = z * z
    return [z, square + v, z * (square + 3 * v), square * square + 6 * square * v + 3 * v * v]


def power_moments_visibility(moments: list[Float], depth: Float) -> Float:
    """1 minus the least fraction of occluders before ``depth`` that the moments allow. Attached."""
    b = [dr.fma(_BIAS, neutral - m, m) for m, neutral in zip(moments, _NEUTRAL, strict=True)]
    z = 2 * depth
    # Cholesky factorisation of the Hankel matrix ((1, b0, b1), (b0, b1, b2), (b1, b2, b3)), solved for (1, z, z^2).
    d22 = _at_least(dr.fma(-b[0], b[0], b[1]), _TINY)
    l32_d22 = dr.fma(-b[0], b[1], b[2])
    d33_d22 = dr.fma(dr.fma(-b[1], b[1], b[3]), d22, -l32_d22 * l32_d22)
    d33 = _at_least(d33_d22 / d22, _TINY)
    l32 = l32_d22 / d22
    y1 = z - b[0]
    # The other two points of support are the roots of c0 + c1 x + c2 x^2. All three are scaled by d33, which may be tiny.
    c2 = dr.fma(-l32, y1, z * z - b[1])
    c1 = dr.fma(-l32, c2, y1 * (d33 / d22))
    c0 = d33 - b[0] * c1 - b[1] * c2
    half = 0.5 * c1
    square = half * half
    root = dr.sqrt(_at_least(dr.fma(-c0, c2, square), dr.fma(square, 1e-7, 1e-22)))
    w = _away_from_zero(-half - dr.select(half < 0, -root, root), 1e-11)
    # One root is ``near``, the other 1 / ``e``. As z moves, the second root passes through infinity, where its weight is zero.
    # Without the inverse, derivatives there would be differences of huge numbers.
    near, e = c0 / w, c2 / w
    to_z, to_near = dr.fma(-z, e, 1), dr.fma(-near, e, 1)
    gap = _away_from_zero(z - near)

    # Weights of z and of the roots: that of point o among x, y and itself is (x y - b0 (x + y) + b1) / ((o - x) (o - y)).
    def others(x: Float) -> Float:
        """Numerator of a weight, times e, if the other two points are x and 1 / e."""
        return x - b[0] * dr.fma(x, e, 1) + b[1] * e

    before_near, before_far = near < z, dr.select(e > 0, to_z < 0, to_z > 0) & (e != 0)
    of_z = -others(near) / (gap * _away_from_zero(to_z))
    of_near = others(z) / (gap * _away_from_zero(to_near))
    of_far = e * e * (dr.fma(z, near, -b[0] * (z + near)) + b[1]) / (_away_from_zero(to_z) * _away_from_zero(to_near))
    shadow = dr.select(before_near, dr.select(before_far, 1 - of_z, of_near), dr.select(before_far, of_far, 0))
    shadow = dr.select(dr.isfinite(shadow), shadow, 0)
    return 1 - dr.clip(shadow, 0, 1)


def _at_least(value: Float, least: Float | float) -> Float:
    return dr.select(value > least, value, least)


def _away_from_zero(value: Float, least: float = _TINY) -> Float:
    Float = type(value)
    return dr.select(dr.abs(value) < least, dr.select(value < 0, Float(-least), Float(least)), value)

"""Convolution shadow maps: the depth comparison as a Fourier series, whose terms can be filtered.

Source: Annen et al., "Convolution Shadow Maps", 2007, equation 8.
"""

from __future__ import annotations

import math

import drjit as dr

from ...jit.types import Float

# The series is periodic: its next step must be far from depths that differ by the whole range.
_BASE = 0.88 * math.pi


def fourier_terms(depth: Float, slope_square: Float | float, order: int) -> list[Float]:
    """Sine and cosine of each of ``order`` odd multiples of a base frequency: 2 ``order`` numbers. Attached.

    A plane's extent within the texel dampens the terms like a normal distribution of the same variance.
    """
    variance = 0.25 * dr.detach(slope_square)
    terms = []
    for k in range(order):
        frequency = _BASE * (2 * k + 1)
        damping = dr.exp(-0.5 * frequency**2 * variance)
        sine, cosine = dr.sincos(frequency * depth)
        terms += [sine * damping, cosine * damping]
    return terms


def fourier_visibility(terms: list[Float], depth: Float) -> Float:
    """Twice the series for the step from 0 (occluder before ``depth``) to 1, clipped to 1: surfaces do not shadow themselves.

    Lanczos factors suppress ringing, which would show as stripes. Attached.
    """
    order = len(terms) // 2
    total = type(depth)(0.5)
    for k in range(order):
        frequency = _BASE * (2 * k + 1)
        x = math.pi * (2 * k + 1) / (2 * order + 1)
        sine, cosine = dr.sincos(frequency * depth)
        difference = terms[2 * k] * cosine - terms[2 * k + 1] * sine
        total += (2 * math.sin(x) / (x * frequency)) * difference
    return dr.clip(2 * total, 0, 1)

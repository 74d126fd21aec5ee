"""Pre-filtered shadow maps by name: the encoding of a depth in each, and the visibility from filtered numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr

from ...jit.arrays import backend
from ...jit.types import Float, Vector2f
from .depth_scale import DepthScale
from .exponential import exponential_moment, exponential_visibility, warped_moments, warped_visibility
from .fourier import fourier_terms, fourier_visibility
from .power_moments import power_moments, power_moments_visibility
from .variance import chebyshev_visibility, reduced_bleeding, variance_moments

# Exponents for which all moments of depths in -1/2..1/2 are far from the limits of single precision.
_ESM, _EVSM2, _EVSM4 = 80.0, 14.0, 20.0
# The minimum variance of warped depths lets a few thousandths of the light through any occluder; these are cut off.
_LEAK = 2e-3


@dataclass(frozen=True)
class Method:
    """A pre-filtered shadow map.

    Attributes:
        encode: (linear depth, squared change of depth across a texel, order, scale) -> numbers to store. Attached to the depth.
        resolve: (the filtered numbers, receiver's depth, scale) -> visibility in 0..1. Attached to the first two.
        bleeds: True if small visibilities may be cut off, see :attr:`ShadowSettings.bleeding`.
        scales: True if depths are told apart on the given scale. Otherwise all that matters is a share of the depth range.
    """

    encode: Callable[[Float, Float | float, int, DepthScale], list[Float]]
    resolve: Callable[[list[Float], Float, DepthScale], Float]
    bleeds: bool = False
    scales: bool = False


def _pair(values: list[Float]) -> Vector2f:
    return backend(values[0]).Array2f(*values)


def _evsm2(values: list[Float], depth: Float, scale: DepthScale) -> Float:
    return reduced_bleeding(warped_visibility(_pair(values), depth, _EVSM2, scale.deviation), _LEAK)


def _evsm4_moments(depth: Float, slope_square: Float | float, order: int, scale: DepthScale) -> list[Float]:
    return [*warped_moments(depth, slope_square, _EVSM4), *warped_moments(depth, slope_square, scale.exponent, -1)]


def _evsm4(values: list[Float], depth: Float, scale: DepthScale) -> Float:
    positive = warped_visibility(_pair(values[:2]), depth, _EVSM4, scale.deviation)
    negative = warped_visibility(_pair(values[2:]), depth, scale.exponent, scale.deviation, -1)
    return reduced_bleeding(_least(positive, negative), _LEAK)


def _least(a: Float, b: Float) -> Float:
    return dr.select(a < b, a, b)


PREFILTERED: dict[str, Method] = {
    "vsm": Method(
        lambda z, slope, order, scale: list(variance_moments(z, slope)),
        lambda values, z, scale: chebyshev_visibility(_pair(values), z),
        bleeds=True,
    ),
    "esm": Method(
        lambda z, slope, order, scale: [exponential_moment(z, _ESM)],
        lambda values, z, scale: exponential_visibility(values[0], z, _ESM),
    ),
    "evsm2": Method(
        lambda z, slope, order, scale: list(warped_moments(z, slope, _EVSM2)),
        _evsm2,
        bleeds=True,
        scales=True,
    ),
    "evsm4": Method(
        _evsm4_moments,
        _evsm4,
        bleeds=True,
        scales=True,
    ),
    "msm": Method(
        lambda z, slope, order, scale: power_moments(z, slope),
        lambda values, z, scale: power_moments_visibility(values, z),
        bleeds=True,
    ),
    "csm": Method(
        lambda z, slope, order, scale: fourier_terms(z, slope, order), lambda values, z, scale: fourier_visibility(values, z)
    ),
}


def most_numbers(method: str, order: int) -> int:
    """Most numbers that a texel stores for a depth, by the name of the method."""
    return max(4, 2 * order) if method == "csm" else 4


#: Hardly any light bleeding, and no more error than ``vsm`` on any scene of `shadowmap-dr maps`, which compares all methods.
DEFAULT = "evsm4"

#: Names of all methods. ``pcf`` and ``standard`` compare depths after the look-up, ``none`` casts no shadows.
METHODS = (*PREFILTERED, "pcf", "standard", "none")

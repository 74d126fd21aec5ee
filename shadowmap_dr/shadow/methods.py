"""The pre-filtered shadow maps by name: what each stores for a depth, and how it turns filtered numbers into visibility."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from ..raster._types import backend
from .fourier import fourier_terms, fourier_visibility
from .hamburger import hamburger_visibility, power_moments
from .moments import (
    chebyshev_visibility,
    exponential_moment,
    exponential_visibility,
    variance_moments,
    warped_moments,
    warped_visibility,
)

# Exponents for which all moments of depths in -1/2..1/2 are far from the limits of single precision.
_ESM, _EVSM, _EVSM_NEGATIVE = 80.0, 40.0, -5.0


@dataclass(frozen=True)
class Method:
    """A shadow map that may be filtered.

    Attributes:
        encode: (linear depth, squared change of depth across a texel, order) -> numbers to store. Attached to the depth.
        resolve: (the filtered numbers, receiver's depth) -> visibility in 0..1. Attached to both.
        bleeds: whether cutting off small visibilities makes sense.
    """

    encode: Callable[[Any, Any, int], list[Any]]
    resolve: Callable[[list[Any], Any], Any]
    bleeds: bool = False


def _pair(values: list[Any]) -> Any:
    return backend(values[0]).Array2f(*values)


def _evsm4(values: list[Any], depth: Any) -> Any:
    positive = warped_visibility(_pair(values[:2]), depth, _EVSM)
    negative = warped_visibility(_pair(values[2:]), depth, _EVSM_NEGATIVE)
    return _least(positive, negative)


def _least(a: Any, b: Any) -> Any:
    return dr.select(a < b, a, b)


PREFILTERED: dict[str, Method] = {
    "vsm": Method(
        lambda z, slope, order: list(variance_moments(z, slope)),
        lambda values, z: chebyshev_visibility(_pair(values), z),
        bleeds=True,
    ),
    "esm": Method(
        lambda z, slope, order: [exponential_moment(z, _ESM)],
        lambda values, z: exponential_visibility(values[0], z, _ESM),
    ),
    "evsm2": Method(
        lambda z, slope, order: list(warped_moments(z, slope, _EVSM)),
        lambda values, z: warped_visibility(_pair(values), z, _EVSM),
        bleeds=True,
    ),
    "evsm4": Method(
        lambda z, slope, order: [*warped_moments(z, slope, _EVSM), *warped_moments(z, slope, _EVSM_NEGATIVE)],
        _evsm4,
        bleeds=True,
    ),
    "msm": Method(lambda z, slope, order: power_moments(z, slope), hamburger_visibility, bleeds=True),
    "csm": Method(fourier_terms, fourier_visibility),
}

#: Names of all methods. ``pcf`` and ``standard`` compare depths after the look-up, ``none`` casts no shadows.
METHODS = (*PREFILTERED, "pcf", "standard", "none")

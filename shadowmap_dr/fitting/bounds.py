"""Bounds and priors of the numbers that a fit varies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError
from .gains import Gain
from .parameters import Parameter
from .starts import LARGEST_FACTOR

Array = npt.NDArray[np.float64]

# Least standard deviation of a prior, in the fit's own numbers: with less, matrices are singular.
_TIGHTEST = 1e-6


@dataclass(frozen=True)
class Bounds:
    """Bounds and priors of all n numbers, in the fit's own numbers.

    Attributes:
        low, high: (n,) bounds.
        prior: (n,) standard deviations of priors.
        given: (n, 2) whether the lower and the upper bound are the user's.
    """

    low: Array
    high: Array
    prior: Array
    given: npt.NDArray[np.bool_]


def bounds_of(parameters: Sequence[Parameter], gains: Sequence[Gain]) -> Bounds:
    """Bounds and priors of parameters, then of gains.

    Raises:
        ShadowmapError: bounds that leave nothing between them; a factor of starts that is too large.
    """
    low, high, prior = [np.zeros(0)], [np.zeros(0)], [np.zeros(0)]
    given = list[tuple[bool, bool]]()
    for parameter in parameters:
        vary, scale, count = parameter.vary, parameter.scale, len(parameter.labels)
        least = parameter.natural[0] if vary.low is None else vary.low
        most = parameter.natural[1] if vary.high is None else vary.high
        nothing = vary.low is not None and vary.high is None and least >= most or vary.high is not None and most <= least
        if nothing or scale.logarithmic and most <= 0:
            least = max(least, 0.0) if scale.logarithmic else least
            raise ShadowmapError(f"{vary.named}: the bounds leave nothing between {least:g} and {most:g}.")
        if vary.spread is not None and scale.logarithmic and not 1 / LARGEST_FACTOR <= vary.spread <= LARGEST_FACTOR:
            raise ShadowmapError(
                f"{vary.named}: spread is {vary.spread:g}, a factor here: give one from 1 to {LARGEST_FACTOR:g}."
            )
        low.append(np.broadcast_to(scale.number(least) if np.isfinite(least) else -np.inf, count))
        high.append(np.broadcast_to(scale.number(most) if np.isfinite(most) else np.inf, count))
        unit = np.abs(scale.shown(np.zeros(count)) if scale.logarithmic else scale.factor)
        given += [(vary.low is not None, vary.high is not None)] * count
        prior.append(np.full(count, np.inf) if vary.prior is None else np.maximum(vary.prior / unit, _TIGHTEST))
    for gain in gains:
        low.append(np.array([-8.0] * gain.colours + [-0.95] * gain.vignetting))
        high.append(np.array([8.0] * gain.colours + [1.0] * gain.vignetting))
        given += [(False, False)] * gain.count
        prior.append(np.full(gain.count, np.inf))
    both = np.array(given, bool).reshape(-1, 2)
    return Bounds(np.concatenate(low), np.concatenate(high), np.concatenate(prior), both)

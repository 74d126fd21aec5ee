"""Search of single numbers without derivatives.

Where few pixels show the effect of each of many numbers, a descent leaves some in minima of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

# Values that are tried, as shares of the range of starts; number of refinements, each at half the distance; and the improvement
# of the loss, as a share, from which on a number changes.
_PLACES, _HALVINGS, _BETTER = np.linspace(-1.25, 1.25, 11), 4, 1e-3


def best_places(
    cost: Callable[[Array], float], x: Array, numbers: Sequence[int], ranges: Array, low: Array, high: Array
) -> tuple[Array, float]:
    """(x with some of its numbers at the best of many values each, the others being kept; its cost).

    Args:
        cost: the loss at numbers (n,).
        x: the numbers (n,) to begin with.
        numbers: those that are searched, one after the other.
        ranges: half ranges of starts of at least these numbers.
        low, high: bounds (n,).
    """
    least = cost(x)
    for k in numbers:
        value, now, step = float(x[k]), least, float(ranges[k]) * (_PLACES[1] - _PLACES[0])
        tried = ranges[k] * _PLACES
        for _ in range(1 + _HALVINGS):
            for one in np.clip(tried, low[k], high[k]).tolist():
                found = cost(_with(x, k, one))
                if found < now:
                    value, now = one, found
            step *= 0.5
            tried = np.array([value - step, value + step])
        if now < (1 - _BETTER) * least:
            x, least = _with(x, k, value), now
    return x, least


def _with(x: Array, number: int, value: float) -> Array:
    changed = x.copy()
    changed[number] = value
    return changed

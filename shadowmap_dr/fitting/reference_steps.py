"""Last steps of fits of few numbers, by differences between Mitsuba's own images.

An image that is corrected where it stands is best there or nearby: shadow maps see small things, such as the roofs of a city from
the air, by one sample of each pixel, and short steps disappear in what these miss. Mitsuba's images have many samples, the same
random numbers before and after a step, and so show it.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from .corrections import Corrections
from .levenberg_marquardt import Damping, Limits, after_step
from .objective import Objective, Point
from .uncertainty import shares_of_intervals

Array = npt.NDArray[np.float64]

#: Most numbers of a scene that are fitted so: each needs two images for a step.
MOST_NUMBERS = 3
# Steps at most; trials of each, every one half as long as the last; share of an interval's half below which a step is the last;
# and improvement of the loss, as a share, below which it is.
_STEPS, _TRIALS, _SLIGHT, _LITTLE = 6, 3, 0.05, 1e-4
# Differences of the images to both sides, as shares of their brightness; the longest way, in the fit's own numbers; effects of
# numbers, such shares for a change by one, below which they stay.
_CHANGE, _FAR, _NOTHING = 0.005, 0.1, 1e-3


def reference_steps(corrections: Corrections, objective: Objective, x: Array, limits: Limits) -> Iterator[Point]:
    """Better and better points of the loss of Mitsuba's images, from the numbers x (n,) on.

    Images stay corrected at the last one that was tried.
    """
    corrections.remove()
    point = _corrected(corrections, objective, x)
    for _ in range(_STEPS):
        if point is None or not _differentiate(point, corrections, objective, limits):
            return
        better = _better(point, corrections, objective, limits)
        if better is None:
            return
        share = shares_of_intervals(better.x - point.x, point, objective).max(initial=0)
        last = share < _SLIGHT or better.cost > (1 - _LITTLE) * point.cost
        point = better
        yield point
        if last:
            return


def _corrected(corrections: Corrections, objective: Objective, x: Array) -> Point | None:
    """The point at the numbers x (n,) with Mitsuba's images. None if it cannot render them."""
    if not corrections.put(x):
        return None
    corrections.keep_constant()
    return objective.at(x)


def _differentiate(point: Point, corrections: Corrections, objective: Objective, limits: Limits) -> bool:
    """Replace a point's derivatives by those of Mitsuba's images. False if there are none."""
    scene = objective.views[0].count
    effect = np.sqrt(np.maximum(np.diag(point.system()[0]) - objective.precision, 0))[:scene]
    numbers, ends = list[int](), list[tuple[Array, Array]]()
    for k in np.flatnonzero(effect > _NOTHING).tolist():
        way = np.zeros(objective.count)
        way[k] = min(_CHANGE / effect[k], _FAR)
        low, high = (np.clip(point.x + sign * way, limits.low, limits.high) for sign in (-1, 1))
        if high[k] > low[k]:
            numbers.append(k)
            ends.append((low, high))
    found = corrections.derivatives(ends, numbers) if numbers else None
    if found is None:
        return False
    point.replace_derivatives(found)
    return True


def _better(point: Point, corrections: Corrections, objective: Objective, limits: Limits) -> Point | None:
    """A better point after a step of Gauss and Newton, or after a part of it. None if there is none."""
    step = after_step(*point.system(), Damping().first, point.x, limits) - point.x
    for _ in range(_TRIALS):
        candidate = _corrected(corrections, objective, point.x + step)
        if candidate is None:
            return None
        if candidate.cost < point.cost:
            return candidate
        step *= 0.5
    return None

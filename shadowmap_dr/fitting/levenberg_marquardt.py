"""Minimisation by Levenberg and Marquardt's method, for few numbers and many residuals.

Source: Nocedal and Wright, "Numerical Optimization", 2006, section 10.3; Marquardt's scaling by the diagonal.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field
from typing import Protocol, TypeVar

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

# Promised decrease, as a share of the cost, for which full steps are taken that may be worse; steps that follow to make them
# better.
_PROMISING, _PROOF = 5e-3, 4


class Residuals(Protocol):
    """A point of an objective."""

    @property
    def x(self) -> Array:
        """The numbers (n,)."""

    @property
    def cost(self) -> float:
        """The loss."""

    def system(self) -> tuple[Array, Array]:
        """(matrix (n, n), right side (n,)) of the normal equations."""


P = TypeVar("P", bound=Residuals)


@dataclass(frozen=True)
class Damping:
    """Damping of steps, as a share of the diagonal.

    Attributes:
        first: of the first step.
        better, worse: factors after a step that is better, or worse.
        failed: least damping after a step that is worse.
        least, most: limits.
    """

    first: float = 1e-3
    better: float = 0.2
    worse: float = 5.0
    failed: float = 0.0
    least: float = 1e-9
    most: float = 1e4


@dataclass(frozen=True)
class Limits:
    """Limits of a minimisation.

    Attributes:
        low, high: bounds (n,) of the numbers.
        longest: largest change of each number in a step.
        steps: most steps.
        improvement: share of the cost; a step that improves less is the last.
        shortest: steps in which no number changes more are the last.
        worth: least share of the cost that the derivatives have to promise of a step.
        dares: most full steps that may be worse.
        damping: damping of steps.
    """

    low: Array
    high: Array
    longest: float = 0.3
    steps: int = 10
    improvement: float = 1e-4
    shortest: float = 1e-5
    worth: float = 0.0
    dares: int = 2
    damping: Damping = field(default_factory=Damping)


def minimise(
    at: Callable[[Array], P], start: P, limits: Limits, follow: Callable[[P, P], P] = lambda before, after: after
) -> Generator[P, None, bool]:
    """Minimise a loss from a point on.

    Losses jump where shadow maps are fitted anew. If steps gain little of what the derivatives promise, a full one is taken, even
    if it is worse; the steps that follow have to make it better. Source: Chamberlain et al., "The watchdog technique for forcing
    convergence in algorithms for constrained optimization", 1982.

    Args:
        at: the point at given numbers.
        start: the first point.
        limits: bounds and ends.
        follow: the better point of a step, from the points before and after it. It may correct the derivatives of the latter.

    Yields:
        Better and better points, one after each step.

    Returns:
        True if steps or improvements had become small, False after the last step of the limits.
    """
    best, left = start, limits.steps
    for dared in range(1 + limits.dares):
        if dared:
            dare = _full_step(at, best, limits)
            if dare is None or not left:
                break
            steps = list(_descent(at, dare, limits, min(left, _PROOF), follow))
            left -= len(steps)
            if not steps or not steps[-1].cost < best.cost:
                break
            best = steps[-1]
            yield best
        for better in _descent(at, best, limits, left, follow):
            best = better
            left -= 1
            yield best
    return left > 0


def _full_step(at: Callable[[Array], P], point: P, limits: Limits) -> P | None:
    """The point after a full step, if its derivatives promise much."""
    matrix, right = point.system()
    step = after_step(matrix, right, limits.damping.first, point.x, limits) - point.x
    if not promised(matrix, right, step) > max(_PROMISING, limits.worth) * point.cost:
        return None
    return None if np.abs(step).max(initial=0) < limits.shortest else at(point.x + step)


def _descent(at: Callable[[Array], P], point: P, limits: Limits, steps: int, follow: Callable[[P, P], P]) -> Iterator[P]:
    """Better and better points, one after each step, until steps or improvements are small."""
    factors = limits.damping
    damping = factors.first
    for _ in range(steps):
        matrix, right = point.system()
        while True:
            x = after_step(matrix, right, damping, point.x, limits)
            if np.abs(x - point.x).max(initial=0) < limits.shortest:
                return
            if limits.worth and promised(matrix, right, x - point.x) < limits.worth * point.cost:
                return
            candidate = at(x)
            if candidate.cost < point.cost:
                break
            if candidate.cost < point.cost * (1 + limits.improvement):
                return  # the differences are those of rounding
            damping = max(damping * factors.worse, factors.failed)
            if damping > factors.most:
                return
        damping = max(damping * factors.better, factors.least)
        gained = (point.cost - candidate.cost) / max(point.cost, 1e-300)
        point = follow(point, candidate)
        yield point
        if gained < limits.improvement:
            return


def promised(matrix: Array, right: Array, step: Array) -> float:
    """Decrease of the loss that the normal equations promise of a step."""
    return -float(right @ step + 0.5 * step @ matrix @ step)


def after_step(matrix: Array, right: Array, damping: float, x: Array, limits: Limits) -> Array:
    """Numbers after a damped step within the bounds, in which no number changes by more than the longest step.

    Numbers at a bound that the loss pushes outwards stay. The number that would go too far by most goes as far as it may, and
    the others are solved for once more: one that moves nothing, and so runs away, does not hold up the others. Numbers that
    reach a bound are equal to it, not up to rounding: the next step looks for them.
    """
    low, high = np.maximum(limits.low, x - limits.longest), np.minimum(limits.high, x + limits.longest)
    step = np.zeros_like(x)
    free = ~(((x <= limits.low) & (right > 0)) | ((x >= limits.high) & (right < 0)))
    diagonal = np.diag(matrix).copy()
    # Numbers that move nothing get no step, and make no matrix singular.
    diagonal = np.maximum(diagonal, 1e-9 * max(diagonal.max(initial=0), 1e-30))
    while free.any():
        damped = matrix[np.ix_(free, free)] + np.diag(damping * diagonal[free] + 1e-12 * diagonal[free])
        step[free] = -np.linalg.solve(damped, right[free] + matrix[np.ix_(free, ~free)] @ step[~free])
        beyond = np.where(free, np.maximum(low - x - step, x + step - high), 0)
        worst = int(np.argmax(beyond))
        if beyond[worst] <= 0:
            break
        step[worst] = np.clip(x[worst] + step[worst], low[worst], high[worst]) - x[worst]
        free[worst] = False
    return np.clip(x + step, low, high)

"""Minimisation by Levenberg and Marquardt's method, for few numbers and many residuals.

Source: Nocedal and Wright, "Numerical Optimization", 2006, section 10.3; Marquardt's scaling by the diagonal.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

# Damping: at first, after success and failure, least and most.
_DAMPING, _BETTER, _WORSE, _LEAST, _MOST = 1e-3, 0.2, 5.0, 1e-9, 1e4
# Full steps that may be worse, at most; promised decrease, as a share of the cost, for which they are taken; steps that follow to
# make them better.
_DARES, _PROMISING, _PROOF = 2, 5e-3, 4
# Share of the promised decrease from which on derivatives are good enough to follow from those before.
_AGREES = 0.5
# Share of a step, of the limits, as which a step with such derivatives counts.
_FOLLOWED = 0.25


P = TypeVar("P", bound="Residuals")


class Residuals(Protocol):
    """A point of an objective. ``x`` (n,); ``cost``: the loss."""

    x: Array
    cost: float

    @property
    def is_exact(self) -> bool:
        """False if derivatives follow from those at other points."""

    def system(self) -> tuple[Array, Array]:
        """(matrix (n, n), right side (n,)) of the normal equations."""

    def follow(self: P, other: P) -> None:
        """Take the derivatives of another point, so changed that they agree with the difference between the two."""

    def refresh(self) -> None:
        """Make derivatives exact: the next system computes them."""


@dataclass(frozen=True)
class Limits:
    """Limits of a minimisation.

    Attributes:
        low, high: bounds (n,) of the numbers.
        longest: largest change of each number in a step.
        steps: most steps.
        improvement: share of the cost; a step that improves less is the last.
        shortest: steps in which no number changes more are the last.
    """

    low: Array
    high: Array
    longest: float = 0.3
    steps: int = 10
    improvement: float = 1e-4
    shortest: float = 1e-5


def minimise(at: Callable[[Array], P], start: P, limits: Limits) -> Generator[P, None, bool]:
    """Minimise a loss from a point on.

    Losses jump where shadow maps are fitted anew. If steps gain little of what the derivatives promise, a full one is taken, even
    if it is worse; the steps that follow have to make it better. Source: Chamberlain et al., "The watchdog technique for forcing
    convergence in algorithms for constrained optimization", 1982.

    Args:
        at: the point at given numbers.
        start: the first point.
        limits: bounds and ends.

    Yields:
        Better and better points, one after each step.

    Returns:
        True if steps or improvements had become small, False after the last step of the limits.
    """
    best, left = start, _Left(limits.steps)
    for dared in range(1 + _DARES):
        if dared:
            dare = _full_step(at, best, limits) if left.steps > 0 else None
            if dare is None:
                break
            own = _Left(min(left.steps, _PROOF))
            left.steps -= own.steps
            steps = list(_descent(at, dare, limits, own))
            left.steps += own.steps
            if not steps or not steps[-1].cost < best.cost:
                break
            best = steps[-1]
            yield best
        for better in _descent(at, best, limits, left):
            best = better
            yield best
    return left.steps > 0


@dataclass
class _Left:
    """Steps that are left. Those with derivatives that follow from others count as a part of one: they take less time."""

    steps: float

    def take(self, *, exact: bool) -> None:
        self.steps -= 1 if exact else _FOLLOWED


def _full_step(at: Callable[[Array], P], point: P, limits: Limits) -> P | None:
    """The point after a full step, if its derivatives promise much."""
    matrix, right = point.system()
    step = _after_step(matrix, right, _DAMPING, point.x, limits) - point.x
    promised = _promised(matrix, right, step)
    if not promised > _PROMISING * point.cost or np.abs(step).max(initial=0) < limits.shortest:
        return None
    return at(point.x + step)


def _promised(matrix: Array, right: Array, step: Array) -> float:
    """Decrease of the cost by a step, as its derivatives promise it."""
    return -float(right @ step + 0.5 * step @ matrix @ step)


def _descent(at: Callable[[Array], P], point: P, limits: Limits, left: _Left) -> Iterator[P]:
    """Better and better points, one after each step, until steps or improvements are small."""
    damping, followed = _DAMPING, 0
    while left.steps > 0:
        matrix, right = point.system()
        while True:
            x = _after_step(matrix, right, damping, point.x, limits)
            short = np.abs(x - point.x).max(initial=0) < limits.shortest
            candidate = None if short else at(x)
            if candidate is not None and candidate.cost < point.cost:
                break
            if not point.is_exact:
                point.refresh()
                matrix, right = point.system()
                followed = 0
                continue
            if candidate is None or candidate.cost < point.cost * (1 + limits.improvement):
                return  # the differences are those of rounding
            damping *= _WORSE
            if damping > _MOST:
                return
        damping = max(damping * _BETTER, _LEAST)
        left.take(exact=point.is_exact)
        step, gained = x - point.x, point.cost - candidate.cost
        last = point.is_exact and gained < limits.improvement * point.cost
        if gained > _AGREES * _promised(matrix, right, step) and gained >= limits.improvement * point.cost and followed < len(x):
            candidate.follow(point)
            followed += 1
        else:
            followed = 0
        point = candidate
        yield point
        if last:
            return


def _after_step(matrix: Array, right: Array, damping: float, x: Array, limits: Limits) -> Array:
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

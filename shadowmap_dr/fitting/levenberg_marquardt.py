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
# Share of the promised decrease from which on derivatives are good enough to follow from those before.
_AGREES = 0.5
# Share of a step, of the limits, as which a step with such derivatives counts.
_FOLLOWED = 0.25

P = TypeVar("P", bound="Residuals")


class Residuals(Protocol):
    """A point of an objective."""

    @property
    def x(self) -> Array:
        """The numbers (n,)."""

    @property
    def cost(self) -> float:
        """The loss."""

    @property
    def is_exact(self) -> bool:
        """False if derivatives follow from those at other points."""

    def system(self) -> tuple[Array, Array]:
        """(matrix (n, n), right side (n,)) of the normal equations."""

    def after(self: P, before: P, *, trusted: bool) -> P:
        """The point to go on from, after a step from another point to this one.

        Derivatives may follow from those before, and from the difference between the two; if the step had the success that these
        promised, they are ``trusted``.
        """

    def refresh(self) -> None:
        """Make derivatives exact: the next system computes them."""


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
    for dared in range(1 + limits.dares):
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
    step = after_step(matrix, right, limits.damping.first, point.x, limits) - point.x
    if not promised(matrix, right, step) > max(_PROMISING, limits.worth) * point.cost:
        return None
    return None if np.abs(step).max(initial=0) < limits.shortest else at(point.x + step)


def _descent(at: Callable[[Array], P], point: P, limits: Limits, left: _Left) -> Iterator[P]:
    """Better and better points, one after each step, until steps or improvements are small."""
    factors = limits.damping
    damping, followed = factors.first, 0
    while left.steps > 0:
        matrix, right = point.system()
        while True:
            x = after_step(matrix, right, damping, point.x, limits)
            step = x - point.x
            short = np.abs(step).max(initial=0) < limits.shortest
            idle = limits.worth > 0 and promised(matrix, right, step) < limits.worth * point.cost
            candidate = None if short or idle else at(x)
            if candidate is not None and candidate.cost < point.cost:
                break
            if not point.is_exact:
                point.refresh()
                matrix, right = point.system()
                followed = 0
                continue
            if candidate is None or candidate.cost < point.cost * (1 + limits.improvement):
                return  # the differences are those of rounding
            damping = max(damping * factors.worse, factors.failed)
            if damping > factors.most:
                return
        damping = max(damping * factors.better, factors.least)
        left.take(exact=point.is_exact)
        gained = point.cost - candidate.cost
        small = gained < limits.improvement * point.cost
        trusted = gained > _AGREES * promised(matrix, right, step) and not small and followed < len(x)
        last = point.is_exact and small
        candidate = candidate.after(point, trusted=trusted)
        followed = 0 if candidate.is_exact else followed + 1
        point = candidate
        yield point
        if last:
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

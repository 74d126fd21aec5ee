"""Intervals and correlations of fitted numbers, and the numbers that pictures do not determine.

Residuals of a fit are no noise: most of them are errors of the model, alike at neighbouring pixels. Their covariance is estimated
from sums over blocks of pixels, a "sandwich" (Liang and Zeger, "Longitudinal data analysis using generalized linear models",
1986). Errors that all of a picture shares are added: a displacement, a wrong brightness, missing light.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .objective import PRIOR_WEIGHT, Objective, Point

Array = npt.NDArray[np.float64]

# Pixels along each side of a block of residuals that may be alike.
_BLOCK = 16
#: Errors that a whole picture shares: displacement of edges in pixels of the fit; factor and offset as shares of its brightness.
DISPLACEMENT, FACTOR, OFFSET = 0.02, 0.004, 0.001
#: Errors of single pixels, as shares of the brightness, that are there even if the residuals do not show them: steps of 8 bits,
#: edges.
PIXEL = 0.005
#: Factor of the blocks' covariance: errors of the model are alike over more than a block; and that of corrected images, which
#: have smaller ones. Found, as the numbers above, on the calibration problems of `shadowmap-dr bench --only fits`: 99 % of 97
#: intervals held the true value there without corrections, and 94 % of 108 do with them.
INFLATION, INFLATION_CORRECTED = 10.0, 3.0
#: Further factor for residuals of users, whose errors are not known as those of colours are. Found on ten places of a box with
#: six functions: half of the intervals by edges and by shares of colours hold the truth without it, all of 120 with it.
OWN_INFLATION = 9.0
# A number with a smaller effect than the first, a share of the brightness for a change by one, is idle if a change by the second
# makes no larger difference than the third: derivatives of outlines are not exact.
_WEAK, _FAR, _SAME = 0.3, 0.3, 0.005
# A larger difference, up to the first number, counts as none if it is below the second times that of a change by the third.
_NEARLY, _GROWN, _NEAR = 0.015, 1.7, 0.1
# But what differs may be a small thing in a large picture: at least so many values of pixels differ by more than the second
# number, a share of the brightness, and images by more than the third times what they do for a change by a third of the distance.
_VALUES, _STRONG, _GROWS = 12, 0.25, 1.2
# And if the scene's own value makes no larger difference than this one.
_ALIKE_AFAR = 0.02
# Numbers may depend on each other where an eigenvalue of the matrix, with a diagonal of one, is smaller: images tell how much.
# Those with a smaller share of the eigenvector have no part in it.
_DEPENDENT, _SHARE = 0.7, 0.02
# Images of the first step differ by about twice the first number, a share of their brightness. Steps grow by the second factor
# while the square of the change is below the third share of the stated one. The others' part is corrected at most so many times
# at each, while that lowers the square to below the fifth share of what it was: where derivatives overstate effects, corrections
# fall short.
_LINEAR, _LONGER, _FEWER, _CORRECTED, _GAIN, _DAMPED = 0.02, 2.0, 0.6, 8, 0.97, 1e-3
# Directions in which numbers move the images by less than this square share of their single effects are not determined. Residuals
# say nothing of them: no change of the images can leave any. Their largest number gets this deviation.
_LEAST, _FREE = 1e-6, 10.0
# Quantile of 95 % intervals, both sides.
_NORMAL = 1.96
# Numbers with a wider interval, in the fit's own numbers, are not determined.
_WIDEST = 1.0
# Two numbers are not told apart if their intervals are wider than the first number, and their correlation is above the second.
_WIDE, _ALIKE = 0.25, 0.97


@dataclass(frozen=True)
class Uncertainty:
    """Covariance (n, n) of the fit's numbers, and the numbers that move nothing.

    Attributes:
        covariance: of all numbers; rows of numbers that move nothing are zero.
        idle: (n,) True for numbers that move nothing in the pictures.
    """

    covariance: Array
    idle: npt.NDArray[np.bool_]

    @property
    def half_widths(self) -> Array:
        """Halves (n,) of 95 % intervals in the fit's numbers, infinite where the pictures do not determine a number."""
        half = _NORMAL * np.sqrt(np.maximum(np.diag(self.covariance), 0))
        return np.where(self.idle | (half > _WIDEST) | ~np.isfinite(half), np.inf, half)

    @property
    def correlations(self) -> Array:
        """Correlations (n, n), zero for numbers that move nothing."""
        deviations = np.sqrt(np.maximum(np.diag(self.covariance), 1e-300))
        found = self.covariance / np.outer(deviations, deviations)
        found[self.idle] = found[:, self.idle] = 0
        np.fill_diagonal(found, 1)
        return np.clip(found, -1, 1)


def uncertainty(point: Point, objective: Objective, low: Array | float = -np.inf, high: Array | float = np.inf) -> Uncertainty:
    """The uncertainty of a fit that ended at a point. ``low``, ``high``: bounds (n,) of its numbers."""
    matrix, _ = point.system()
    moved = np.sqrt(np.maximum(np.diag(matrix - np.diag(objective.precision)), 0))
    # Shares of the brightness that a change of a number by one makes.
    idle = moved < 1e-6
    for k in np.flatnonzero(~idle & (moved < _WEAK)):
        idle[k] = _is_idle(np.eye(objective.count)[k], point, objective, low, high)
        if idle[k]:  # a light that is off by now moved much when it was on
            given = np.where(np.arange(objective.count) == k, np.clip(0, low, high), point.x)
            idle[k] = np.sqrt(_square(objective.at(given), point, point, objective)) < _ALIKE_AFAR
    covariance = _covariance(point, objective, idle)
    return Uncertainty(covariance + _dependence(matrix, covariance, idle, point, objective, low, high), idle)


def shares_of_intervals(step: Array, point: Point, objective: Objective) -> Array:
    """A step (n,) to a point, in half-widths of the intervals there, without what further images would tell of them."""
    matrix, _ = point.system()
    idle = np.asarray(np.diag(matrix) - objective.precision < 1e-12)
    half = Uncertainty(_covariance(point, objective, idle), idle).half_widths
    return np.abs(step) / np.maximum(half, 1e-30)


def _covariance(point: Point, objective: Objective, idle: npt.NDArray[np.bool_]) -> Array:
    """Covariance (n, n) of the numbers at a point, by its residuals; of those that move nothing zero."""
    total = objective.terms
    inverse, free = _inverse(point.system()[0] * total, idle)
    # Where a prior alone determines a number, its interval is the prior's.
    unknown = OWN_INFLATION if objective.has_own_residuals else 1.0
    inflation = INFLATION_CORRECTED if objective.is_corrected and not objective.has_own_residuals else INFLATION
    scores = unknown * inflation * _scores(point, objective) + PRIOR_WEIGHT * np.diag(objective.precision * total)
    covariance = inverse @ scores @ inverse + unknown * PIXEL**2 * inverse + free @ free.T
    for error in _shared_errors(point, objective):
        shift = inverse @ error
        covariance += unknown * np.outer(shift, shift)
    return covariance


def _dependence(
    matrix: Array,
    covariance: Array,
    idle: npt.NDArray[np.bool_],
    point: Point,
    objective: Objective,
    low: Array | float,
    high: Array | float,
) -> Array:
    """Further covariance (n, n) of numbers that can make up for each other, such as the size of a shape and its distance.

    Derivatives of outlines are not exact, and hide it: images tell how little such numbers change together.
    """
    keep, result, done = np.flatnonzero(~idle), np.zeros_like(matrix), set[int]()
    scale = np.sqrt(np.diag(matrix)[keep])
    values, vectors = np.linalg.eigh(matrix[np.ix_(keep, keep)] / np.outer(scale, scale))
    for k in np.flatnonzero((values > _LEAST) & (values < _DEPENDENT)):
        number = int(keep[np.abs(vectors[:, k]).argmax()])
        held = objective.precision[keep][np.abs(vectors[:, k]) > _SHARE].any()  # by a prior
        if number in done or held:
            continue
        done.add(number)
        others = keep[keep != number]
        ratio, direction = _joint_change(number, others, matrix, point, objective, low, high)
        direction[keep[np.abs(direction[keep]) * scale < _SHARE * np.abs(direction[keep] * scale).max()]] = 0
        variance = min(float(covariance[number, number]) * (ratio**-2 - 1), (_FREE / np.abs(direction).max()) ** 2)
        result += variance * np.outer(direction, direction)
    return result


def _joint_change(
    number: int,
    others: npt.NDArray[np.intp],
    matrix: Array,
    point: Point,
    objective: Objective,
    low: Array | float,
    high: Array | float,
) -> tuple[float, Array]:
    """(square of the images' change, in shares of that which derivatives state, when others make up for one number; direction).

    The direction (n,) has a one at the number. It starts as derivatives say, and is corrected by differences of images. Steps are
    short at first: independent numbers leave the range of their derivatives soon. They grow as long as the images change less
    than stated, since errors of single pixels hide that over a short distance.
    """
    own = matrix[np.ix_(others, others)]
    own = own + _DAMPED * np.diag(np.diag(own))
    direction = np.zeros(objective.count)
    direction[number], direction[others] = 1, -np.linalg.solve(own, matrix[others, number])
    stated = max(float(direction @ matrix @ direction), 1e-30)
    best, found, step = 1.0, direction.copy(), _LINEAR / np.sqrt(stated)
    while True:
        far, before = min(step, _FAR / np.abs(direction).max()), np.inf
        for _ in range(_CORRECTED):
            ends = [np.clip(point.x + sign * far * direction, low, high) for sign in (1, -1)]
            length = float((ends[0] - ends[1])[number])
            if length <= 0:
                return best, found
            above, below = (objective.at(end) for end in ends)
            ratio = max(_square(above, below, point, objective) / length**2 / stated, 1e-6)
            if ratio < best:
                best, found = ratio, direction.copy()
            if ratio > _GAIN * before:
                break
            before = ratio
            direction[others] -= np.linalg.solve(own, _products(above, below, point, objective)[others] / length)
        if best > _FEWER or far < step:
            return best, found
        step *= _LONGER


def _is_idle(direction: Array, point: Point, objective: Objective, low: Array | float, high: Array | float) -> bool:
    """True if images along a direction are alike.

    Differences in proportion to the distance tell. Those of facets do not grow with it, and shadow maps that are fitted anew make
    a step somewhere. Small things change few pixels, but these much.
    """
    (far, strength), (near, _) = (_effect(direction, point, objective, low, high, step) for step in (_FAR, _NEAR))
    alike = min(far, near * _FAR / _NEAR) < _SAME or far < _NEARLY and far < _GROWN * near
    several = objective.terms * far**2 >= _VALUES * strength**2
    return bool(alike and not (several and strength > _STRONG and far > _GROWS * near))


def _effect(
    direction: Array, point: Point, objective: Objective, low: Array | float, high: Array | float, far: float
) -> tuple[float, float]:
    """(root mean square of the change of the images along a direction, root mean square where they change).

    Both are shares of the brightness for steps of ``far`` to either side. Pixels count the more in the second, the more they
    change.
    """
    ends = [np.clip(point.x + sign * far * direction, low, high) for sign in (1, -1)]
    step = float(np.linalg.norm(ends[0] - ends[1]) / np.linalg.norm(direction))
    if not step:
        return np.inf, np.inf
    one, other = (objective.at(end) for end in ends)
    square, fourth = (_mean_power(one, other, point, objective, power) for power in (2, 4))
    return 2 * far / step * float(np.sqrt(square)), float(np.sqrt(fourth / max(square, 1e-300)))


def _square(one: Point, other: Point, point: Point, objective: Objective) -> float:
    """Mean square of the difference of two images, weighted as at a point; a share of the brightness."""
    return _mean_power(one, other, point, objective, 2)


def _mean_power(one: Point, other: Point, point: Point, objective: Objective, power: int) -> float:
    """Mean of an even power of the difference of two images, weighted as at a point."""
    total = 0.0
    for first, second, weight in zip(one.residuals, other.residuals, point.weights(), strict=True):
        total += float((weight * np.square(first - second, dtype=np.float64).reshape(-1) ** (power // 2)).sum())
    return total / objective.terms


def _products(one: Point, other: Point, point: Point, objective: Objective) -> Array:
    """Products (n,) of a point's derivatives with the difference of two images, weighted as :func:`_square` does."""
    total = np.zeros(objective.count)
    for columns, first, second, weight in zip(point.columns(), one.residuals, other.residuals, point.weights(), strict=True):
        total += columns @ (weight * (first - second).reshape(-1))
    return total / objective.terms


def not_told_apart(found: Uncertainty) -> list[tuple[int, int]]:
    """Pairs of numbers that have nearly the same effect, or the opposite one, on the pictures."""
    wide = found.half_widths > _WIDE
    high = np.argwhere(np.triu(np.abs(found.correlations), 1) * np.outer(wide, wide) > _ALIKE)
    return [(int(a), int(b)) for a, b in high]


def _inverse(matrix: Array, idle: npt.NDArray[np.bool_]) -> tuple[Array, Array]:
    """(inverse (n, n) of the matrix in directions that it determines, deviations (n, k) along the k others).

    Rows of idle numbers are zero.
    """
    keep = np.flatnonzero(~idle)
    own = matrix[np.ix_(keep, keep)]
    scale = np.sqrt(np.maximum(np.diag(own), 1e-300))
    values, vectors = np.linalg.eigh(own / np.outer(scale, scale))
    vectors /= scale[:, None]
    known = values > _LEAST
    inverse, free = np.zeros_like(matrix), np.zeros((len(matrix), int((~known).sum())))
    inverse[np.ix_(keep, keep)] = (vectors[:, known] / values[known]) @ vectors[:, known].T
    free[keep] = _FREE * vectors[:, ~known] / np.abs(vectors[:, ~known]).max(0, initial=1e-300)
    return inverse, free


def _scores(point: Point, objective: Objective) -> Array:
    """Sum over blocks of the outer products of the blocks' sums of weighted residuals times derivatives.

    Sums of a block that alone tells of a number, such as the height of a small house, are zero where the fit ends. So single
    pixels count, too, by their blocks' shares of what a picture tells of each number.
    """
    total = np.zeros((objective.count, objective.count))
    for columns, weight, residual in zip(point.columns(), point.weights(), point.residuals, strict=True):
        shape = objective.count, *residual.shape
        product = (columns * (weight * residual.reshape(-1))).reshape(shape).sum(3, dtype=np.float64)
        told = _sums_of_blocks((columns**2 * weight).reshape(shape).sum(3, dtype=np.float64))
        share = told / np.maximum(told.sum((1, 2), keepdims=True), 1e-300)
        row, column = (np.arange(side) // _BLOCK for side in residual.shape[:2])
        for parts in (_sums_of_blocks(product), product * np.sqrt(share[:, row[:, None], column])):
            flat = parts.reshape(objective.count, parts[0].size if len(parts) else 0)
            total += flat @ flat.T
    return total


def _sums_of_blocks(values: Array) -> Array:
    """Sums (n, rows, columns) over the blocks of images (n, H, W)."""
    _, height, width = values.shape
    return np.add.reduceat(np.add.reduceat(values, range(0, height, _BLOCK), 1), range(0, width, _BLOCK), 2)


def _shared_errors(point: Point, objective: Objective) -> list[Array]:
    """Right sides (n,) of errors that all of a picture shares."""
    found = []
    each = zip(point.columns(), point.weights(), point.recorded, objective.observations, objective.comparisons, strict=True)
    for columns, weight, image, seen, compared in each:
        shown = image.astype(np.float64)
        down, right = np.gradient(shown, axis=(0, 1)) if min(shown.shape[:2]) > 1 else (0 * shown, 0 * shown)
        offset = np.full_like(shown, OFFSET * seen.brightness)
        errors = [np.asarray(one, np.float32) for one in (DISPLACEMENT * down, DISPLACEMENT * right, FACTOR * shown, offset)]
        for error in compared.derivatives(image, errors):
            found.append((columns * weight).astype(np.float64) @ np.nan_to_num(error, posinf=0, neginf=0).reshape(-1))
    return found

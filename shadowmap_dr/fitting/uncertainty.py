"""Intervals and correlations of fitted numbers, and the numbers that pictures do not determine.

Residuals of a fit are no noise: most of them are errors of the model, alike at neighbouring pixels. Their covariance is estimated
from sums over blocks of pixels, a "sandwich" (Liang and Zeger, "Longitudinal data analysis using generalized linear models",
1986). Errors that all of a picture shares are added: a displacement, a wrong brightness, missing light.

Derivatives of edges are right in sums over pixels, not in each pixel. Where numbers have the same effect, or none, these
differences look like an effect. Images at a distance tell: directions with a small effect are measured with them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .objective import PRIOR_WEIGHT, Objective, Point

Array = npt.NDArray[np.float64]
#: Derivatives for each picture: (n, H W 3), or (H W 3,) along one direction.
Columns = list[npt.NDArray[np.float32]]

# Pixels along each side of a block of residuals that may be alike.
_BLOCK = 16
#: Errors that a whole picture shares: displacement of edges in pixels of the fit; factor and offset as shares of its brightness.
DISPLACEMENT, FACTOR, OFFSET = 0.02, 0.004, 0.001
#: Errors of single pixels, as shares of the brightness, that are there even if the residuals do not show them: steps of 8 bits,
#: edges.
PIXEL = 0.005
#: Factor of the blocks' covariance: errors of the model are alike over more than a block. Found, as the numbers above, on the
#: calibration problems of `shadowmap-dr bench --only fits`, of which 96 % of the intervals then hold the true value.
INFLATION = 10.0
# Directions in which a step of one changes the images by a smaller share of the brightness are not determined. Residuals say
# nothing of them: no change of the images can leave any. They get this deviation, but for numbers with a small share in them.
_LEAST, _FREE, _SHARE = 1e-3, 3.0, 0.01
# Directions with a smaller effect of a step of one are measured: by steps from the second to the third number, so often.
_WEAK, _NEAR, _FAR, _ROUNDS = 1.0, 0.01, 0.3, 4
# Change of the images, as a share of the brightness, by which derivatives are measured.
_CHANGE = 0.03
# Change of the images, as a share of the brightness, from one end to the other, up to which they are the same.
_SAME = 0.005
# Quantile of 95 % intervals, both sides.
_NORMAL = 1.96
# Numbers with a wider interval, in the fit's own numbers, are not determined.
_WIDEST = 1.0
# Two numbers are not told apart if their intervals are wider than the first number, and their correlation is above the second.
_WIDE, _ALIKE = 0.1, 0.97


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
    bounds, identity = (low, high), np.eye(objective.count)
    columns = point.columns()
    alone = _measured(identity, _of(columns, point, objective).covariance, columns, point, objective, bounds)
    columns = alone or columns
    # Combinations with a small effect are found by differences of images, which agree better with each other.
    differences = _differences(columns, point, objective, bounds)
    for _ in range(_ROUNDS):
        vectors, covariance = np.linalg.eigh(_products(differences, point))[1], _of(differences, point, objective).covariance
        measured = _measured(vectors, covariance, differences, point, objective, bounds)
        if measured is None:
            break
        differences = measured
    return _of(_weakened(columns, differences, point, objective), point, objective)


def _differences(columns: Columns, point: Point, objective: Objective, bounds: tuple[Array | float, Array | float]) -> Columns:
    """Derivatives by differences of images that change by a share of the brightness; as given where bounds leave no room."""
    found = [own.copy() for own in columns]
    for k, vector in enumerate(np.eye(objective.count)):
        effect = _size([own[k] for own in columns], point) / np.sqrt(3 * objective.pixels)
        if effect > 1e-6:
            step = _difference(vector, min(_CHANGE / effect, _FAR), point, objective, bounds)
            for own, one in zip(found, step or [own[k] for own in columns], strict=True):
                own[k] = one
    return found


def _weakened(columns: Columns, others: Columns, point: Point, objective: Objective) -> Columns:
    """Derivatives with the effects of others along directions in which these are small, and smaller."""
    vectors, limit = np.linalg.eigh(_products(others, point))[1], _WEAK * np.sqrt(3 * objective.pixels)
    along, small = ([vectors.T.astype(np.float32) @ own for own in each] for each in (columns, others))
    for k in range(objective.count):
        size = _size([own[k] for own in small], point)
        if size < min(limit, _size([own[k] for own in along], point)):
            for own, one in zip(along, small, strict=True):
                own[k] = one[k]
    return [(vectors @ own).astype(np.float32) for own in along]


def _products(columns: Columns, point: Point) -> Array:
    """Sums (n, n) over pixels of weighted products of derivatives."""
    pairs = zip(columns, point.weights(), strict=True)
    return np.asarray(sum((own * weight).astype(np.float64) @ own.T.astype(np.float64) for own, weight in pairs))


def _of(columns: Columns, point: Point, objective: Objective) -> Uncertainty:
    """The uncertainty with derivatives of the residuals."""
    total, products = 3 * objective.pixels, _products(columns, point)
    idle = np.sqrt(np.diag(products) / total) < 1e-6
    keep, matrix = np.flatnonzero(~idle), products + np.diag(objective.precision * total)
    values, vectors = np.linalg.eigh(matrix[np.ix_(keep, keep)])
    known = np.sqrt(np.maximum(values, 0) / total) > _LEAST
    inverse, free = np.zeros_like(matrix), np.zeros((len(matrix), int((~known).sum())))
    inverse[np.ix_(keep, keep)] = (vectors[:, known] / values[known]) @ vectors[:, known].T
    free[keep] = np.where(np.abs(vectors[:, ~known]) < _SHARE, 0, vectors[:, ~known])
    # Where a prior alone determines a number, its interval is the prior's.
    scores = INFLATION * _scores(columns, point, objective) + PRIOR_WEIGHT * np.diag(objective.precision * total)
    covariance = inverse @ scores @ inverse + PIXEL**2 * inverse + _FREE**2 * free @ free.T
    for error in _shared_errors(columns, point, objective):
        shift = inverse @ error
        covariance += np.outer(shift, shift)
    return Uncertainty(covariance, idle)


def _measured(
    vectors: Array,
    covariance: Array,
    columns: Columns,
    point: Point,
    objective: Objective,
    bounds: tuple[Array | float, Array | float],
) -> Columns | None:
    """Derivatives in which small effects along unit vectors (n, n; columns) are those of images at a distance.

    None if no such effect is smaller than the derivative.
    """
    total, changed = 3 * objective.pixels, False
    along = [vectors.T.astype(np.float32) @ own for own in columns]
    for k, vector in enumerate(vectors.T):
        effect = _size([own[k] for own in along], point)
        if not 1e-6 < effect / np.sqrt(total) < _WEAK:
            continue
        far = _difference(vector, _FAR, point, objective, bounds)
        if far is None:
            continue
        found, distance = far, max(3 * float(np.sqrt(max(vector @ covariance @ vector, 0))), _NEAR)
        if 2 * _FAR * _size(far, point) / np.sqrt(total) < _SAME:
            found = [0 * own for own in far]
        elif distance < _FAR:
            found = _difference(vector, distance, point, objective, bounds) or far
        if _size(found, point) < effect:
            changed = True
            for own, one in zip(along, found, strict=True):
                own[k] = one
    return [(vectors @ own).astype(np.float32) for own in along] if changed else None


def _difference(
    direction: Array, distance: float, point: Point, objective: Objective, bounds: tuple[Array | float, Array | float]
) -> Columns | None:
    """Difference quotient (H W 3,) of each picture's images along a direction, within bounds; None if these leave no room."""
    ends = []
    for sign in (1, -1):
        with np.errstate(divide="ignore", invalid="ignore"):
            room = np.where(sign * direction > 0, bounds[1] - point.x, bounds[0] - point.x) / (sign * direction)
        ends.append(min(distance, float(np.nanmin(np.where(direction == 0, np.inf, room), initial=np.inf))))
    if not ends[0] + ends[1] > 0.2 * distance:
        return None
    above, below = (objective.at(point.x + step * direction) for step in (ends[0], -ends[1]))
    pairs = zip(above.residuals, below.residuals, strict=True)
    found = [np.asarray((a - b).reshape(-1) / (ends[0] + ends[1]), np.float32) for a, b in pairs]
    return found if all(np.isfinite(own).all() for own in found) else None


def _size(changes: Columns, point: Point) -> float:
    """Root of the weighted sum of squares of images (H W 3,)."""
    pairs = zip(changes, point.weights(), strict=True)
    return float(np.sqrt(sum(float((weight * own.astype(np.float64) ** 2).sum()) for own, weight in pairs)))


def not_told_apart(found: Uncertainty) -> list[tuple[int, int]]:
    """Pairs of numbers that have nearly the same effect, or the opposite one, on the pictures."""
    wide = found.half_widths > _WIDE
    high = np.argwhere(np.triu(np.abs(found.correlations), 1) * np.outer(wide, wide) > _ALIKE)
    return [(int(a), int(b)) for a, b in high]


def _scores(derivatives: Columns, point: Point, objective: Objective) -> Array:
    """Sum over blocks of the outer products of the blocks' sums of weighted residuals times derivatives."""
    total = np.zeros((objective.count, objective.count))
    for columns, weight, residual in zip(derivatives, point.weights(), point.residuals, strict=True):
        rows, width, _ = residual.shape
        product = (columns * (weight * residual.reshape(-1))).reshape(objective.count, rows, width, 3).sum(3, dtype=np.float64)
        blocks = np.add.reduceat(np.add.reduceat(product, range(0, rows, _BLOCK), 1), range(0, width, _BLOCK), 2)
        flat = blocks.reshape(objective.count, -1)
        total += flat @ flat.T
    return total


def _shared_errors(derivatives: Columns, point: Point, objective: Objective) -> list[Array]:
    """Right sides (n,) of errors that all of a picture shares."""
    found = []
    each = zip(derivatives, point.weights(), point.recorded, objective.brightness, strict=True)
    for columns, weight, image, scale in each:
        shown = image.astype(np.float64) / scale
        down, right = np.gradient(shown, axis=(0, 1)) if min(shown.shape[:2]) > 1 else (0 * shown, 0 * shown)
        for error in (DISPLACEMENT * down, DISPLACEMENT * right, FACTOR * shown, np.full_like(shown, OFFSET)):
            found.append((columns * weight).astype(np.float64) @ error.reshape(-1))
    return found

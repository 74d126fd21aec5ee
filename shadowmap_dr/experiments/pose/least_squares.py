"""Least squares of differences between images of a pose and a reference: linear models, and damped steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...fitting.parameters import Parameter
from ...fitting.stages import size_of
from ...fitting.targets import Target
from ...fitting.views import Quality, View
from ...rendering.renderer import Renderer

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.float32]

# Longest change of a number in a step: radians, or scene units.
_LONGEST = 0.3
# Damping: at first, least, after a failure at least, most; factors after success and after failure.
_DAMPING, _LEAST, _AFTER_FAILURE, _MOST, _BETTER, _WORSE = 1e-3, 1e-6, 0.03, 1.0, 0.2, 8.0
# Least share of the loss that a step has to promise.
_WORTH = 0.1
# Least factor by which derivatives are scaled to the changes of images. Noise does not make them smaller than they are.
_SMALLEST = 0.5


@dataclass(frozen=True)
class Linear:
    """Linear model of differences: ``columns`` (n, N) are their derivatives by n numbers."""

    columns: Array

    def step(self, difference: Array, damping: float = 0.0) -> Array:
        """Step (n,) to the least squares of the model, from where the differences (N,) are, shortened to the longest change.

        ``damping``: times the diagonal of the normal equations.
        """
        matrix = self.columns @ self.columns.T
        diagonal = np.diag(matrix)
        matrix += np.diag(damping * diagonal + 1e-12 * max(diagonal.max(), 1e-30))
        step: Array = -np.linalg.solve(matrix, self.columns @ difference)
        return step * min(1.0, _LONGEST / max(np.abs(step).max(), 1e-30))

    def promise(self, difference: Array, step: Array) -> float:
        """Decrease of the mean square that the model expects of a step."""
        change = step @ self.columns
        return -float(np.mean(change * (2 * difference + change)))

    def factor(self, step: Array, change: Array) -> float:
        """Factor with which the model's change along a step is nearest to that of the images, ``change`` (N,), within limits.

        Derivatives at few samples hold noise, which the normal equations take for change: steps become too short by up to a half.
        """
        expected = step @ self.columns
        # Sums of products, not `@`: the threads of the linear algebra and those of Dr.Jit would wait for each other.
        return float(np.clip(np.sum(expected * change) / max(np.sum(expected * expected), 1e-30), _SMALLEST, 1.0))

    def times(self, factor: float | Array) -> Linear:
        """The model with all derivatives times a factor, or those by each number times its own, (n, 1)."""
        return Linear(self.columns * factor)


@dataclass(frozen=True)
class Difference:
    """Differences (N,) between the image at a pose ``x`` (n,) and the reference, their model, and their mean square, ``loss``."""

    x: Array
    values: Array
    model: Linear
    loss: float


class Differences:
    """Differences of linear colours between images of a scene at one quality and a reference.

    Args:
        renderer: of the scene. It is not changed.
        parameter: what moves.
        reference: the reference at its own size.
        quality: of the images.
        block: side in pixels of blocks over which differences are averaged; it divides the sides of the images.
    """

    def __init__(self, renderer: Renderer, parameter: Parameter, reference: Target, quality: Quality, block: int = 1) -> None:
        size = size_of(reference, quality.side)
        self._view = View(renderer, [parameter], [], 0, size, quality)
        self._reference, self._block = reference.resized(size.width, size.height).image, block

    def image(self, x: Array) -> Image:
        """Linear image (H, W, 3) at the numbers x (n,)."""
        return self._view.image(x)

    def difference(self, x: Array) -> Array:
        """Averaged differences (N,) at x."""
        return self._averaged(self._view.image(x))

    def loss(self, x: Array) -> float:
        """Mean square of the averaged differences at x."""
        return mean_square(self.difference(x))

    def columns(self, x: Array) -> Array:
        """Derivatives (n, H W 3) of the images by all numbers at x."""
        return np.array([np.ravel(one) for one in self._view.jacobian(x)[1]], np.float64)

    def at(self, x: Array) -> Difference:
        """Differences at x with their model, without averages over blocks."""
        image, derivatives = self._view.jacobian(x)
        values = np.ravel(image - self._reference).astype(np.float64)
        columns = np.array([np.ravel(one) for one in derivatives], np.float64)
        return Difference(x, values, Linear(columns), mean_square(values))

    def _averaged(self, image: Image) -> Array:
        height, width, channels = image.shape
        side, difference = self._block, image - self._reference
        return np.ravel(difference.reshape(height // side, side, width // side, side, channels).mean((1, 3), dtype=np.float64))


def mean_square(values: Array) -> float:
    """Mean of the squares of values (N,)."""
    return float(np.mean(np.square(values)))


class DampedSteps:
    """Steps of Levenberg and Marquardt's method.

    Args:
        differences: what is minimised.
        start: (n,) numbers.
        shortest: steps in which no number changes more are not taken.
        fixed: numbers that stay as they are, by their index.

    Attributes:
        point: the current point.
    """

    def __init__(self, differences: Differences, start: Array, shortest: float, fixed: Sequence[int] = ()) -> None:
        self._differences, self._shortest, self._damping = differences, shortest, _DAMPING
        self._moves = np.array([number not in fixed for number in range(len(start))], np.float64)[:, None]
        self.point = differences.at(start)
        self._model = self.point.model.times(self._moves)

    def advance(self) -> bool:
        """Go to a better point. False, at the same point, if no step is worth it."""
        point = self.point
        while self._damping <= _MOST:
            step = self._model.step(point.values, self._damping)
            if np.abs(step).max() < self._shortest or self._model.promise(point.values, step) < _WORTH * point.loss:
                return False
            candidate = self._differences.at(point.x + step)
            if candidate.loss < point.loss:
                self._damping = max(self._damping * _BETTER, _LEAST)
                # The noise of the next derivatives is about that of these.
                factor = point.model.factor(step, candidate.values - point.values)
                self.point, self._model = candidate, candidate.model.times(factor * self._moves)
                return True
            self._damping, self._model = max(self._damping * _WORSE, _AFTER_FAILURE), point.model.times(self._moves)
        return False

"""Least squares of differences between images of a pose and a reference, and their linear models."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ...fitting.parameters import Parameter
from ...fitting.stages import size_of
from ...fitting.targets import Target
from ...fitting.views import Quality, View
from ...rendering.renderer import Renderer

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.float32]

# Least factor by which derivatives are scaled to the changes of images. Noise does not make them smaller than they are.
_SMALLEST = 0.5


@dataclass(frozen=True)
class Linear:
    """Linear model of differences: ``columns`` (n, N) are their derivatives by n numbers."""

    columns: Array

    def system(self, difference: Array) -> tuple[Array, Array]:
        """(matrix (n, n), right side (n,)) of the normal equations of the mean square, where the differences (N,) are."""
        scale = 2 / difference.size
        return scale * self.columns @ self.columns.T, scale * self.columns @ difference

    def factor(self, step: Array, change: Array) -> float:
        """Factor with which the model's change along a step is nearest to that of the images, ``change`` (N,), within limits.

        Derivatives at few samples hold noise, which the normal equations take for change: steps become too short by up to a half.
        """
        expected = step @ self.columns
        # Sums of products, not `@`: the threads of the linear algebra and those of Dr.Jit would wait for each other.
        return float(np.clip(np.sum(expected * change) / max(np.sum(expected * expected), 1e-30), _SMALLEST, 1.0))

    def times(self, factor: float) -> Linear:
        """The model with all derivatives times a factor."""
        return Linear(self.columns * factor)


@dataclass(frozen=True)
class Difference:
    """Differences (N,) between the image at a pose ``x`` (n,) and the reference, and their model.

    ``cost``: their mean square. ``scale``: factor of all derivatives, see :meth:`after`.
    """

    x: Array
    values: Array
    model: Linear
    cost: float
    scale: float = 1.0

    def system(self) -> tuple[Array, Array]:
        """(matrix (n, n), right side (n,)) of the normal equations."""
        return self.model.times(self.scale).system(self.values)

    @property
    def is_exact(self) -> bool:
        """True: derivatives are those of this point, but for their scale."""
        return True

    def after(self, before: Difference, *, trusted: bool) -> Difference:
        """This point, after a step from another one, with derivatives scaled as those should have been along the step.

        The noise of the next derivatives is about that of the last ones.
        """
        return replace(self, scale=before.model.factor(self.x - before.x, self.values - before.values))

    def refresh(self) -> None:
        """Nothing to do: derivatives are exact."""


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

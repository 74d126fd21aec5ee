"""Differences between images and pictures as a function of a fit's numbers, with the normal equations of Gauss and Newton."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..jit.types import Float
from .gains import Gain
from .losses import Loss
from .views import View

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.float32]

# Differences that remain in good fits, as shares of a picture's brightness, and pixels that err alike: they weigh priors.
_USUAL, _ALIKE = 0.02, 64
#: Weight of a prior's squares beside those of residuals.
PRIOR_WEIGHT = _USUAL**2 * _ALIKE


@dataclass(frozen=True)
class Observation:
    """A picture at the size of a view: linear ``image`` (H, W, 3), ``weight`` (H, W) of its pixels, and its ``gain``."""

    image: Image
    weight: Image
    gain: Gain

    @property
    def brightness(self) -> float:
        """Root of the mean square of the weighted pixels."""
        total = 3.0 * float(self.weight.sum(dtype=np.float64))
        square = float((self.weight[..., None] * self.image.astype(np.float64) ** 2).sum())
        return float(np.sqrt(square / max(total, 1e-30))) or 1.0


@dataclass(frozen=True)
class Correction:
    """A linear function of a fit's numbers, with images (H, W, 3) as values.

    Attributes:
        image: its value at the numbers ``x`` (n,).
        slopes: images (k, H, W, 3).
        weights: (k, n): derivatives by the numbers are sums of the slopes, with these weights.
    """

    image: Image
    x: Array
    slopes: Image
    weights: Array

    def at(self, x: Array) -> Image:
        """Its value at the numbers x (n,)."""
        return self.image + self._sum(self.weights @ (x - self.x))

    def derivative(self, number: int) -> Image:
        """Its derivative by one of the numbers."""
        return self._sum(self.weights[:, number])

    def _sum(self, weights: Array) -> Image:
        return np.tensordot(weights.astype(np.float32), self.slopes, 1)


class Objective:
    """The loss of a fit at one quality.

    Args:
        views: one for each picture; all with the same parameters.
        observations: the pictures.
        prior: (n,) standard deviations about zero of all numbers, infinite for none.
        loss: the loss of residuals.

    Attributes:
        gains: the numbers of each picture's gain.
        count: number of all numbers.
        corrections: of each view's image, added to it; None for none.
    """

    def __init__(self, views: Sequence[View], observations: Sequence[Observation], prior: Array, loss: Loss) -> None:
        self.views, self.observations, self.loss = tuple(views), tuple(observations), loss
        self.brightness = [observation.brightness for observation in observations]
        self.pixels = float(sum(observation.weight.sum(dtype=np.float64) for observation in observations))
        self.precision = PRIOR_WEIGHT / (3 * self.pixels) / np.square(prior)
        self._scene = views[0].count
        ends = np.cumsum([self._scene, *(observation.gain.count for observation in observations)])
        self.gains = [slice(int(a), int(b)) for a, b in zip(ends[:-1], ends[1:], strict=True)]
        self.count = int(ends[-1])
        self.corrections: list[Correction | None] = [None] * len(self.views)

    def at(self, x: Array) -> Point:
        """The residuals at x (n,)."""
        return Point(self, np.asarray(x, np.float64))

    def set_values(self, values: Sequence[Float]) -> None:
        """Set the values of the parameters with many values."""
        for view in self.views:
            view.values = list(values)

    def gradient(self, x: Array) -> list[Float]:
        """Derivatives of the mean loss by the values of the parameters with many values, Float each."""
        total: list[Float] = []
        for number, (view, seen) in enumerate(zip(self.views, self.observations, strict=True)):
            scale, shape = self.brightness[number], np.zeros((*seen.weight.shape, 3), np.float32)
            factors = seen.gain.factors(shape, x[self.gains[number]]) / scale
            weight = seen.weight[..., None] / (3 * self.pixels)
            correction = self.corrections[number]
            target = seen.image / scale if correction is None else seen.image / scale - factors * correction.at(x)
            found = view.gradient(x, target, weight, factors, self.loss.limit)
            total = [a + b for a, b in zip(total, found, strict=True)] if total else found
        return total

    def recorded(self, number: int, image: Image, x: Array) -> Image:
        """The image of a view as its picture's camera records it."""
        return self.observations[number].gain.apply(image, x[self.gains[number]])


class Point:
    """Residuals of all pictures at one x, as shares of the pictures' brightness, and their derivatives when asked for.

    Attributes:
        cost: mean loss of the weighted residuals, and the priors' share.
        error: root of the mean square of the weighted residuals.
    """

    def __init__(self, owner: Objective, x: Array) -> None:
        self.x, self._owner = x, owner
        self.images = [view.image(x).copy() for view in owner.views]
        corrected = [image if c is None else image + c.at(x) for image, c in zip(self.images, owner.corrections, strict=True)]
        self.recorded = [owner.recorded(k, image, x) for k, image in enumerate(corrected)]
        pairs = zip(self.recorded, owner.observations, owner.brightness, strict=True)
        self.residuals = [np.asarray((image - seen.image) / scale, np.float32) for image, seen, scale in pairs]
        cost = square = 0.0
        for residual, seen in zip(self.residuals, owner.observations, strict=True):
            weight = seen.weight[..., None]
            cost += float((weight * owner.loss.value(residual)).sum(dtype=np.float64))
            square += float((weight * residual * residual).sum(dtype=np.float64))
        total = 3 * max(owner.pixels, 1e-30)
        self.cost = cost / total + 0.5 * float((owner.precision * x * x).sum())
        self.error = float(np.sqrt(square / total))
        if not np.isfinite(self.cost):
            self.cost = self.error = np.inf
        self._columns: list[npt.NDArray[np.float32]] | None = None

    def columns(self) -> list[npt.NDArray[np.float32]]:
        """Derivatives of the residuals by all numbers: for each picture (n, H W 3)."""
        if self._columns is None:
            self._columns = [self._of_view(k) for k in range(len(self.images))]
        return self._columns

    def weights(self) -> list[npt.NDArray[np.float32]]:
        """Weights of the residuals, of the pictures' and the loss's: for each picture (H W 3,)."""
        pairs = zip(self.residuals, self._owner.observations, strict=True)
        return [(seen.weight[..., None] * self._owner.loss.weight(residual)).reshape(-1) for residual, seen in pairs]

    def system(self) -> tuple[Array, Array]:
        """(matrix (n, n), right side (n,)) of the normal equations, means over the residuals: matrix step = - right side."""
        owner, count = self._owner, self._owner.count
        matrix, right = np.zeros((count, count)), np.zeros(count)
        for columns, weight, residual in zip(self.columns(), self.weights(), self.residuals, strict=True):
            weighted = columns * weight
            matrix += weighted @ columns.T
            right += weighted @ residual.reshape(-1)
        total = 3 * max(owner.pixels, 1e-30)
        return matrix / total + np.diag(owner.precision), right / total + owner.precision * self.x

    def _of_view(self, number: int) -> npt.NDArray[np.float32]:
        owner, view = self._owner, self._owner.views[number]
        scale, gain, own = owner.brightness[number], owner.observations[number].gain, owner.gains[number]
        correction = owner.corrections[number]
        columns = np.zeros((owner.count, self.residuals[number].size), np.float32)
        with view.scene_at(self.x):
            for k in range(view.count):
                _, derivative = view.derivative(self.x, k)
                if correction is not None:
                    derivative = derivative + correction.derivative(k)
                columns[k] = (gain.apply(derivative, self.x[own]) / scale).reshape(-1)
        # Of the image without its correction, to which the scene's own numbers do not contribute either: the exposure and the
        # strength of all lights have the same derivatives.
        plain = owner.recorded(number, self.images[number], self.x)
        for k, derivative in enumerate(gain.derivatives(plain, self.x[own])):
            columns[own.start + k] = (derivative / scale).reshape(-1)
        columns[~np.isfinite(columns)] = 0
        return columns

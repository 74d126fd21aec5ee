"""Differences between images and pictures as a function of a fit's numbers, with the normal equations of Gauss and Newton."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from ..jit.types import Float
from .affine_image import AffineImage
from .comparison import Colours, Comparison, Observation
from .losses import Loss
from .own_losses import OwnFunction, OwnLoss, OwnResiduals
from .views import View

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.float32]

# Differences that remain in good fits, as shares of a picture's brightness, and pixels that err alike: they weigh priors.
_USUAL, _ALIKE = 0.02, 64
# Difference of two images, as a share of the brightness, that jumps from pixel to pixel may make.
_JUMPS = 0.01
#: Weight of a prior's squares beside those of residuals.
PRIOR_WEIGHT = _USUAL**2 * _ALIKE


class Objective:
    """The loss of a fit at one quality.

    Args:
        views: one for each picture; all with the same parameters.
        observations: the pictures.
        prior: (n,) standard deviations about zero of all numbers, infinite for none.
        loss: the loss of residuals.
        residuals: a user's residuals instead of differences of colours.
        own_loss: a user's loss instead of that of residuals, for textures and vertices alone.

    Attributes:
        comparisons: residuals of each picture.
        gains: the numbers of each picture's gain.
        count: number of all numbers.
        corrections: of each view's image, added to it; None for none.
        terms: sum of the weights of all residuals.
    """

    def __init__(
        self,
        views: Sequence[View],
        observations: Sequence[Observation],
        prior: Array,
        loss: Loss,
        residuals: OwnFunction | None = None,
        own_loss: OwnFunction | None = None,
    ) -> None:
        self.views, self.observations, self.loss = tuple(views), tuple(observations), loss
        self.comparisons: list[Comparison] = [
            Colours(seen) if residuals is None else OwnResiduals(residuals, seen) for seen in observations
        ]
        self.has_own_residuals = residuals is not None
        self.own_losses = [] if own_loss is None else [OwnLoss(own_loss, seen) for seen in observations]
        self.terms = sum(_terms(one, seen) for one, seen in zip(self.comparisons, observations, strict=True))
        self.precision = PRIOR_WEIGHT / self.terms / np.square(prior)
        self._scene = views[0].count
        ends = np.cumsum([self._scene, *(observation.gain.count for observation in observations)])
        self.gains = [slice(int(a), int(b)) for a, b in zip(ends[:-1], ends[1:], strict=True)]
        self.count = int(ends[-1])
        self.corrections: list[AffineImage | None] = [None] * len(self.views)
        # The last point with derivatives: corrections that change at its numbers change neither its images nor them.
        self.last: Point | None = None
        self._latest: tuple[Array, list[Image]] | None = None

    @property
    def is_corrected(self) -> bool:
        """True if the images of all views are corrected."""
        return all(one is not None for one in self.corrections)

    def at(self, x: Array) -> Point:
        """The residuals at x (n,)."""
        return Point(self, np.asarray(x, np.float64))

    def images(self, x: Array) -> list[Image]:
        """Images of all views at x (n,), without gains and corrections. Those of the last call are kept: gains change none."""
        own = np.asarray(x, np.float64)[: self._scene]
        if self.last is not None and np.array_equal(self.last.x[: self._scene], own):
            return self.last.images
        if self._latest is None or not np.array_equal(self._latest[0], own):
            self._latest = own.copy(), [view.image(x).copy() for view in self.views]
        return self._latest[1]

    def set_values(self, values: Sequence[Float]) -> None:
        """Set the values of the parameters with many values."""
        self.last = self._latest = None
        for view in self.views:
            view.values = list(values)

    def gradient(self, x: Array) -> list[Float]:
        """Derivatives of the mean loss by the values of the parameters with many values, Float each."""
        total: list[Float] = []
        for number in range(len(self.views)):
            found = self._gradient(number, x)
            total = [a + b for a, b in zip(total, found, strict=True)] if total else found
        return total

    def _gradient(self, number: int, x: Array) -> list[Float]:
        """The share of one picture in :meth:`gradient`."""
        view, seen, compared = self.views[number], self.observations[number], self.comparisons[number]
        correction = self.corrections[number]
        factors = seen.gain.factors(np.zeros((*seen.weight.shape, 3), np.float32), x[self.gains[number]])
        if isinstance(compared, Colours) and not self.own_losses:
            # Image and derivatives in one pass.
            scale = seen.brightness
            weight = seen.weight[..., None] / self.terms
            target = seen.image if correction is None else seen.image - factors * correction.at(x)
            return view.gradient(x, np.asarray(target / scale, np.float32), weight, factors / scale, self.loss.limit)
        plain = view.image(x)
        image = self.recorded(number, plain if correction is None else plain + correction.at(x), x)
        if self.own_losses:
            adjoint: Image = self.own_losses[number].gradient(image) / np.float32(len(self.views))
        else:
            residual = compared.residuals(image)
            weight = compared.weight / np.float32(self.terms)
            adjoint = compared.adjoint(image, weight * self.loss.weight(residual) * residual)
        return view.pulled(x, adjoint * factors)

    def recorded(self, number: int, image: Image, x: Array) -> Image:
        """The image of a view as its picture's camera records it."""
        return self.observations[number].gain.apply(image, x[self.gains[number]])


class Point:
    """Residuals of all pictures at one x, as shares of what the pictures show, and their derivatives when asked for.

    Attributes:
        cost: mean loss of the weighted residuals, and the priors' share.
        error: root of the mean square of the weighted residuals.
    """

    def __init__(self, owner: Objective, x: Array) -> None:
        self.x, self._owner = x, owner
        known = owner.last if owner.last is not None and np.array_equal(owner.last.x, x) else None
        self.images: list[Image] = owner.images(x)
        corrected = [image if c is None else image + c.at(x) for image, c in zip(self.images, owner.corrections, strict=True)]
        self.recorded = [owner.recorded(k, image, x) for k, image in enumerate(corrected)]
        pairs = zip(self.recorded, owner.comparisons, strict=True)
        self.residuals = [compared.residuals(image) for image, compared in pairs]
        cost = square = 0.0
        for residual, compared in zip(self.residuals, owner.comparisons, strict=True):
            cost += float((compared.weight * owner.loss.value(residual)).sum(dtype=np.float64))
            square += float((compared.weight * residual * residual).sum(dtype=np.float64))
        self.cost = cost / owner.terms + 0.5 * float((owner.precision * x * x).sum())
        self.error = float(np.sqrt(square / owner.terms))
        if owner.own_losses:
            values = [own.value(image) for own, image in zip(owner.own_losses, self.recorded, strict=True)]
            self.cost = float(np.mean(values))
        if not np.isfinite(self.cost):
            self.cost = self.error = np.inf
        self._columns: list[npt.NDArray[np.float32]] | None = None
        self._derivatives: list[Image] | None = None if known is None else known._derivatives
        self.is_exact: bool = known is None or known.is_exact

    def after(self, before: Point, *, trusted: bool) -> Point:
        """This point, after a step from another one, whose derivatives it takes if they are trusted.

        They are so changed that they agree with the difference between the images.

        Source: Broyden, "A class of methods for solving nonlinear simultaneous equations", 1965. Numbers are scaled by their
        effects on the images. Images jump a little with each step, so short ones change little.
        """
        if not trusted:
            return self
        count, matrix = self._owner.views[0].count, before.system()[0]
        step = (self.x - before.x)[:count]
        effect = np.maximum(np.diag(matrix) - self._owner.precision, 0)[:count]
        scaled = effect * step / (float(effect @ step**2) + _JUMPS**2)
        self._derivatives, self.is_exact, self._owner.last = [], False, self
        for image, old, derivatives in zip(self.images, before.images, before.derivatives(), strict=True):
            missed = image - old - np.tensordot(step.astype(np.float32), derivatives, 1)
            self._derivatives.append(derivatives + scaled.astype(np.float32)[:, None, None, None] * missed)
        return self

    def refresh(self) -> None:
        """Make derivatives exact that follow from those of another point: they are computed when asked for."""
        if not self.is_exact:
            self._derivatives = self._columns = None
            self.is_exact = True

    def replace_derivatives(self, images: list[Image]) -> None:
        """Use other derivatives of the images by the scene's numbers: for each picture (n, H, W, 3), or more rows."""
        self._derivatives, self._columns = [one[: self._owner.views[0].count] for one in images], None

    def derivatives(self) -> list[Image]:
        """Derivatives of the images, without their corrections, by the scene's numbers: for each picture (n, H, W, 3)."""
        if self._derivatives is None:
            self._derivatives, self._owner.last = [self._of_view(view) for view in self._owner.views], self
        return self._derivatives

    def columns(self) -> list[npt.NDArray[np.float32]]:
        """Derivatives of the residuals by all numbers: for each picture (n, H W 3)."""
        if self._columns is None:
            self._columns = [self._columns_of(k) for k in range(len(self.images))]
        return self._columns

    def weights(self) -> list[npt.NDArray[np.float32]]:
        """Weights of the residuals, of the pictures' and the loss's: for each picture (H W 3,)."""
        pairs = zip(self.residuals, self._owner.comparisons, strict=True)
        return [(compared.weight * self._owner.loss.weight(residual)).reshape(-1) for residual, compared in pairs]

    def system(self) -> tuple[Array, Array]:
        """(matrix (n, n), right side (n,)) of the normal equations, means over the residuals: matrix step = - right side."""
        owner, count = self._owner, self._owner.count
        matrix, right = np.zeros((count, count)), np.zeros(count)
        for columns, weight, residual in zip(self.columns(), self.weights(), self.residuals, strict=True):
            weighted = columns * weight
            matrix += weighted @ columns.T
            right += weighted @ residual.reshape(-1)
        return matrix / owner.terms + np.diag(owner.precision), right / owner.terms + owner.precision * self.x

    def _of_view(self, view: View) -> Image:
        with view.scene_at(self.x):
            return view.derivatives(self.x)

    def _columns_of(self, number: int) -> npt.NDArray[np.float32]:
        owner = self._owner
        gain, own = owner.observations[number].gain, owner.gains[number]
        correction, changes = owner.corrections[number], dict[int, Image]()
        for k, derivative in enumerate(self.derivatives()[number]):
            whole = derivative if correction is None else derivative + correction.derivative(k)
            changes[k] = gain.apply(whole, self.x[own])
        # At the image without its correction, to which the scene's own numbers do not contribute either: the exposure and the
        # strength of all lights have the same derivatives.
        plain = owner.recorded(number, self.images[number], self.x)
        for k, derivative in enumerate(gain.derivatives(plain, self.x[own])):
            changes[own.start + k] = derivative
        columns = np.zeros((owner.count, self.residuals[number].size), np.float32)
        found = owner.comparisons[number].derivatives(plain, list(changes.values()))
        for k, derivative in zip(changes, found, strict=True):
            columns[k] = derivative.reshape(-1)
        columns[~np.isfinite(columns)] = 0
        return columns


def _terms(compared: Comparison, seen: Observation) -> float:
    """Sum of the weights of a picture's residuals; not zero."""
    shape = compared.residuals(seen.image).shape
    return max(float(np.broadcast_to(compared.weight, shape).sum(dtype=np.float64)), 1e-30)

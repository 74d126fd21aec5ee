"""Corrections of a fit's images by images of the scene's own integrator, Mitsuba's.

Shadow maps have filters, lamps have few samples, and light bounces: the best image of a fit is not that of the true scene. The
difference between Mitsuba's image and the fit's own hardly changes with small steps, so it is added to all images of the last
stage, and rendered again after some steps. Where it does change, its derivatives follow from the differences that were rendered
before: secants, as in Broyden's method. In the end Mitsuba's image is fitted, by derivatives of shadow maps.

Sources: Alexandrov and Lewis, "An overview of first-order model management for engineering optimization", 2001; Bandler et al.,
"Space mapping: the state of the art", 2004.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError
from ..io.resampling import area_average
from ..rendering.renderer import Renderer
from .affine_image import AffineImage
from .estimates import changes_of
from .objective import Objective
from .reference import Reference, reduced

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.float32]

# Changes of the images, as a share of the brightness, that noise may make: shorter secants count little. Most secants.
_NOISE, _SECANTS = 0.003, 6
# Pixels along each side of the blocks in which secants are constant.
_BLOCK = 12


class Corrections:
    """Corrections of the images of an objective.

    Args:
        renderer: the renderer of the scene as it was given.
        objective: of the last stage.
        windows: (W, H) of the pictures, in pixels.

    Attributes:
        failure: reason for which Mitsuba could not render the changed scene; empty if it could.
    """

    def __init__(self, renderer: Renderer, objective: Objective, windows: list[tuple[int, int]]) -> None:
        self._renderer, self._objective = renderer, objective
        self._reference = Reference(renderer.data, windows)
        # Numbers, and differences of the images of each pass (P, H, W, 3) at them, the last one first.
        self._known: list[tuple[Array, list[Image]]] = []
        # Effect of each number on the images, where they were first corrected.
        self._effect: Array | None = None
        self.failure = ""

    def put(self, x: Array) -> bool:
        """Correct the images so that they are Mitsuba's at the numbers x (n,). False if it cannot render them."""
        if self._known and np.array_equal(self._known[0][0], x):
            return True
        images = self._rendered(x)
        if images is None:
            return False
        objective = self._objective
        own = objective.images(x)
        differences = [passes - image for passes, image in zip(self._reference.passes, own, strict=True)]
        self._known = [(x.copy(), differences), *self._known[:_SECANTS]]
        weights = self._weights(x)
        for number, (image, plain) in enumerate(zip(images, own, strict=True)):
            here = differences[number]
            slopes = np.array([_change(here, other[number]) for _, other in self._known[1:]]).reshape(-1, *image.shape)
            objective.corrections[number] = AffineImage(image - plain, x.copy(), slopes, weights)
        return True

    def derivatives(self, ends: Sequence[tuple[Array, Array]], numbers: Sequence[int]) -> list[Image] | None:
        """Derivatives of Mitsuba's images by some numbers, as differences between the ends (n,), (n,) of a way for each.

        For each view (n, H, W, 3); those by other numbers are zero. None if it cannot render one of the images.
        """
        objective = self._objective
        found = [np.zeros((objective.count, view.size.height, view.size.width, 3), np.float32) for view in objective.views]
        for k, (low, high) in zip(numbers, ends, strict=True):
            below, above = (self._rendered(end, most_passes=1) for end in (low, high))
            if below is None or above is None:
                return None
            for images, one, other in zip(found, below, above, strict=True):
                images[k] = (other - one) / np.float32(high[k] - low[k])
        return found

    def _rendered(self, x: Array, most_passes: int | None = None) -> list[Image] | None:
        """Mitsuba's images at the numbers x (n,). None if it cannot render them."""
        views = self._objective.views
        changes = changes_of(views[0].change(x), self._renderer)
        cameras, sizes = [view.camera(x) for view in views], [view.size for view in views]
        try:
            return self._reference.images(changes, cameras, sizes, most_passes)
        except (ShadowmapError, RuntimeError) as error:
            self.failure = " ".join(str(error).split()).rstrip(".")
            return None

    def keep(self, x: Array) -> None:
        """Keep the images' corrections at the numbers x (n,): those where they were rendered differ too little to matter."""
        self._known[0] = x.copy(), self._known[0][1]

    def keep_constant(self) -> None:
        """Leave out the secants: derivatives are then those of shadow maps alone, without noise."""
        plain = [one and replace(one, slopes=one.slopes[:0], weights=one.weights[:0]) for one in self._objective.corrections]
        self._objective.corrections = plain

    def _weights(self, x: Array) -> Array:
        """Weights (k, n) of the k secants: those with which they agree best with steps of the numbers.

        Steps are measured by their effect on the images. Gains have no part in them.
        """
        if self._effect is None:
            matrix, _ = self._objective.at(x).system()
            of_images = np.diag(matrix) - self._objective.precision  # without the priors' share
            self._effect = np.sqrt(np.maximum(of_images, 0))
            self._effect[self._objective.views[0].count :] = 0
        effect = self._effect
        steps = np.array([other - x for other, _ in self._known[1:]]).reshape(len(self._known) - 1, len(x)) * effect
        return np.asarray(np.linalg.solve(steps @ steps.T + _NOISE**2 * np.eye(len(steps)), steps) * effect)

    def share(self, objectives: Sequence[Objective], x: Array) -> None:
        """Correct the images of several objectives, of the same pictures, by the constant differences at the numbers x (n,).

        Coarse images have large errors: coarse filters of shadow maps, few samples of lamps. They hide small objects.
        """
        if not self.put(x):
            return
        rendered = self._reference.rendered
        self.remove()
        for objective in objectives:
            for number, (image, view) in enumerate(zip(rendered, objective.views, strict=True)):
                difference = reduced(image, view.size) - view.image(x)
                none = np.zeros((0, *difference.shape), np.float32)
                objective.corrections[number] = AffineImage(difference, x.copy(), none, np.zeros((0, len(x))))

    def remove(self) -> None:
        """Leave the images as they are."""
        self._objective.corrections = [None] * len(self._objective.views)
        self._known, self._effect = [], None


def _change(here: Image, there: Image) -> Image:
    """Difference of two images from their passes (P, H, W, 3): those that both have, whose noise is alike."""
    count = min(len(here), len(there))
    return _smooth(np.asarray(there[:count].mean(0) - here[:count].mean(0), np.float32))


def _smooth(image: Image) -> Image:
    """An image without its noise, which the residuals have, too: steps would follow it."""
    height, width, _ = image.shape
    few = -(-height // _BLOCK), -(-width // _BLOCK)
    small = area_average(lambda rows: image[rows], (height, width), few)
    return area_average(lambda rows: small[rows], few, (height, width))

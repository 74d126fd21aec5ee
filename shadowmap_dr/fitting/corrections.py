"""Corrections of a fit's images by images of the scene's own integrator, Mitsuba's.

Shadow maps have filters, lamps have few samples, and light bounces: the best image of a fit is not that of the true scene. The
difference between Mitsuba's image and the fit's own hardly changes with small steps, so it is added to all images of the last
stage, and rendered again after some steps. In the end Mitsuba's image is fitted, by derivatives of shadow maps.

Source: additive corrections of cheap models, Alexandrov and Lewis, "An overview of first-order model management for engineering
optimization", 2001.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError
from ..rendering.renderer import Renderer
from .estimates import changes_of
from .objective import Objective
from .reference import Reference

Array = npt.NDArray[np.float64]


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
        self._at: Array | None = None
        self.failure = ""

    def put(self, x: Array) -> bool:
        """Correct the images so that they are Mitsuba's at the numbers x (n,). False if it cannot render them."""
        objective = self._objective
        if self._at is not None and np.array_equal(self._at, x):
            return True
        self.remove()
        changes = changes_of(objective.views[0].change(x), self._renderer)
        cameras = [view.camera(x) for view in objective.views]
        try:
            images = self._reference.images(changes, cameras, [view.size for view in objective.views])
        except (ShadowmapError, RuntimeError) as error:
            self.failure = " ".join(str(error).split()).rstrip(".")
            return False
        for number, image in enumerate(images):
            objective.corrections[number] = image - objective.views[number].image(x)
        self._at = x.copy()
        return True

    def remove(self) -> None:
        """Leave the images as they are."""
        self._objective.corrections = [None] * len(self._objective.views)
        self._at = None

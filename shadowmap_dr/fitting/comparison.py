"""Comparison of images with a picture: residuals, their derivatives, and their weights. That of colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from .gains import Gain

Image = npt.NDArray[np.float32]


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


class Comparison(Protocol):
    """Comparison of images (H, W, 3) with one picture.

    Residuals are arrays (rows, columns, channels) without unit: one is as large as the picture itself. ``weight`` broadcasts to
    them.
    """

    @property
    def weight(self) -> Image: ...

    def residuals(self, image: Image) -> Image:
        """Residuals of an image."""

    def derivatives(self, image: Image, changes: Sequence[Image]) -> list[Image]:
        """Derivatives of the residuals of an image along changes (H, W, 3) of it."""

    def adjoint(self, image: Image, adjoint: Image) -> Image:
        """Gradient by the image (H, W, 3), from that by the residuals."""

    def contents(self, image: Image) -> tuple[Image, Image]:
        """Contents of image and picture: residuals between each of them and a picture that shows nothing.

        Only differences between neighbours, and squares, have a meaning.
        """


class Colours:
    """Differences of colours, as shares of the picture's brightness."""

    def __init__(self, seen: Observation) -> None:
        self._picture, self._scale = seen.image, seen.brightness
        self.weight = seen.weight[..., None]

    def residuals(self, image: Image) -> Image:
        return np.asarray((image - self._picture) / self._scale, np.float32)

    def derivatives(self, image: Image, changes: Sequence[Image]) -> list[Image]:
        return [np.asarray(change / self._scale, np.float32) for change in changes]

    def adjoint(self, image: Image, adjoint: Image) -> Image:
        return np.asarray(adjoint / self._scale, np.float32)

    def contents(self, image: Image) -> tuple[Image, Image]:
        return image / self._scale, self._picture / self._scale

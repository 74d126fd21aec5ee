"""Exposure, white balance and vignetting of a picture: factors between a linear image and what a camera recorded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Gain:
    """Factors of a picture, by numbers g: logarithms of the exposure (one, or one for each colour), and the vignetting.

    Attributes:
        colours: number of fitted exposures: 0, 1, or 3 with white balance.
        vignetting: True if the darkening towards the corners is fitted: the last number.
        known: the picture's known exposure, a factor of all colours.
    """

    colours: int = 0
    vignetting: bool = False
    known: float = 1.0

    @property
    def count(self) -> int:
        """Number of fitted numbers."""
        return self.colours + self.vignetting

    def apply(self, image: Image, g: Array) -> Image:
        """Image (H, W, 3) times the factors."""
        return np.asarray(image * self.factors(image, g), np.float32)

    def derivatives(self, recorded: Image, g: Array) -> list[Image]:
        """Derivatives of :meth:`apply`'s result ``recorded`` by each number."""
        found: list[Image] = []
        if self.colours == 1:
            found.append(recorded)
        if self.colours == 3:
            found += [recorded * np.eye(3, dtype=np.float32)[k] for k in range(3)]
        if self.vignetting:
            square = _square_radius(recorded)
            found.append(np.asarray(recorded * square / (1 + g[-1] * square), np.float32))
        return found

    def colour_factors(self, g: Array) -> Array:
        """Factors (3,) of the colours in the middle of the picture."""
        exposure = np.exp(g[: self.colours]) if self.colours else np.ones(1)
        return self.known * np.broadcast_to(exposure, 3).astype(np.float64)

    def factors(self, image: Image, g: Array) -> Image:
        """Factors of an image (H, W, 3), which broadcast to it."""
        factors = self.colour_factors(g)
        if not self.vignetting:
            return factors.astype(np.float32)
        return np.asarray(factors * (1 + g[-1] * _square_radius(image)), np.float32)


def _square_radius(image: Image) -> Image:
    """(H, W, 1) squared distance from the middle of a picture, 1 in its corners."""
    rows, columns = image.shape[:2]
    x, y = (np.arange(columns) + 0.5) * 2 / columns - 1, (np.arange(rows) + 0.5) * 2 / rows - 1
    longer = max(rows, columns)
    x, y = x * columns / longer, y * rows / longer
    square = x[None, :] ** 2 + y[:, None] ** 2
    corner = (columns / longer) ** 2 + (rows / longer) ** 2
    return np.asarray(square / corner, np.float32)[..., None]

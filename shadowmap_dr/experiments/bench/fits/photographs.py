"""Photographs of linear pictures: exposure, white balance, vignetting, noise, 8 bits, JPEG."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ....io.images import to_srgb

Array = npt.NDArray[np.float64]
#: Variance of noise for each unit of brightness (photons), and without light (read-out).
_PHOTONS, _READOUT = 1.2e-4, 9e-6


@dataclass(frozen=True)
class Photograph:
    """A camera's work on a linear picture.

    Attributes:
        exposure: factor.
        white: factors of red and blue.
        vignetting: tangent of the angle at the corners; light falls off by the fourth power of the cosine. 0: none.
        noise: whether there is noise of photons and of the sensor.
        quality: of the JPEG file; None: PNG.
    """

    exposure: float
    white: tuple[float, float] = (1.0, 1.0)
    vignetting: float = 0.0
    noise: bool = False
    quality: int | None = None

    @property
    def suffix(self) -> str:
        return ".png" if self.quality is None else ".jpg"

    def taken(self, picture: npt.ArrayLike, seed: int) -> npt.NDArray[np.uint8]:
        """8-bit sRGB (H, W, 3) of a linear picture (H, W, 3)."""
        light = np.asarray(picture, float) * self.exposure * np.array([self.white[0], 1, self.white[1]])
        light *= falloff(light.shape[0], light.shape[1], self.vignetting)[..., None]
        if self.noise:
            random = np.random.default_rng(seed)
            light += random.normal(size=light.shape) * np.sqrt(_PHOTONS * np.maximum(light, 0) + _READOUT)
        return np.round(to_srgb(light) * 255).astype(np.uint8)

    def write(self, path: Path, picture: npt.ArrayLike, seed: int) -> None:
        """Take a photograph of a linear picture and write it."""
        from PIL import Image

        image = Image.fromarray(self.taken(picture, seed))
        if self.quality is None:
            image.save(path)
        else:
            image.save(path, quality=self.quality)


def falloff(height: int, width: int, tangent: float) -> Array:
    """Vignetting (H, W): the fourth power of the cosine of the angle to the axis, by its tangent at the corners."""
    y, x = (np.arange(height) + 0.5 - height / 2)[:, None], np.arange(width) + 0.5 - width / 2
    square = (x * x + y * y) / (0.25 * (height**2 + width**2)) * tangent**2
    return (1 + square) ** -2.0

"""Images that are affine functions of a fit's numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.float32]


@dataclass(frozen=True)
class AffineImage:
    """An affine function of a fit's numbers, with images (H, W, 3) as values.

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

"""Cheap stand-ins for a renderer: an image that depends smoothly on vertex positions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np


@dataclass(frozen=True)
class BlobRenderer:
    """Each vertex is a Gaussian blob; its depth sets the brightness. Can cross `dr.freeze`."""

    pixel_x: Any
    pixel_y: Any
    size: int
    vertices: int

    @classmethod
    def create(cls, size: int, vertices: int) -> BlobRenderer:
        x, y = dr.meshgrid(*(dr.linspace(mi.Float, -1.5, 1.5, size) for _ in range(2)))
        return cls(x, y, size, vertices)

    def render(self, vertex_positions: dict[str, Any]) -> Any:
        p = vertex_positions["object"]
        value = dr.zeros(mi.Float, self.size**2)
        for i in range(self.vertices):
            x, y, z = (dr.gather(mi.Float, p, 3 * i + k) for k in range(3))
            value += (1 + 0.3 * z) * dr.exp(-8 * (dr.square(self.pixel_x - x) + dr.square(self.pixel_y - y)))
        return mi.TensorXf(value, (self.size, self.size, 1))


POINTS = np.array([[-0.9, -0.5, 0.1], [0.8, -0.4, -0.3], [0.1, 0.7, 0.5], [0.5, 0.2, 0.9]], np.float32)

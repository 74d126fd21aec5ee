"""A mesh that modelling begins with."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, eq=False)
class StartMesh:
    """A mesh as it is before anybody paints. Two records are never equal, so each one stands for one beginning.

    Attributes:
        name: shown on the page.
        vertices: (V, 3), in the page's coordinates.
        faces: (F, 3).
        middle, scale: (3,) and a number. The file's vertices are vertices * scale + middle.
    """

    name: str
    vertices: npt.NDArray[np.float32]
    faces: npt.NDArray[np.uint32]
    middle: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    scale: float = 1.0

    def placed(self, vertices: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
        """Vertices (V, 3) of the page in the place and size of the file."""
        return np.asarray(vertices * self.scale + self.middle, np.float64)

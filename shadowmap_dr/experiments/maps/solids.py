"""Solids of which buildings are put together. Lengths are metres, z is up; corners of quads run counter-clockwise from above.

Each point has a *rise*: its change of height when the height of its building changes by one. A wall's foot has 0, a roof has 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Points = npt.NDArray[np.float64]
Faces = npt.NDArray[np.uint32]


@dataclass(frozen=True)
class Solid:
    """A closed mesh, faces outwards.

    Attributes:
        points: (V, 3) metres.
        faces: (F, 3) indices of points.
        rise: (V,) change of z for a unit of the building's height.
    """

    points: Points
    faces: Faces
    rise: Points

    def moved(self, x: float, y: float, z: float = 0.0) -> Solid:
        """The same solid elsewhere."""
        return Solid(self.points + np.array([x, y, z]), self.faces, self.rise)


def joined(solids: Sequence[Solid]) -> Solid:
    """Several solids as one mesh."""
    starts = np.cumsum([0, *(len(solid.points) for solid in solids)])
    faces = [solid.faces + np.uint32(start) for solid, start in zip(solids, starts, strict=False)]
    points, rise = (np.concatenate([getattr(solid, name) for solid in solids]) for name in ("points", "rise"))
    return Solid(points, np.concatenate(faces), rise)


def rectangle(x0: float, y0: float, x1: float, y1: float, beyond: float = 0.0) -> Points:
    """Corners (4, 2) of a rectangle that is wider by ``beyond`` on each side."""
    x0, y0, x1, y1 = x0 - beyond, y0 - beyond, x1 + beyond, y1 + beyond
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def widened(quad: Points, beyond: float) -> Points:
    """An axis-parallel rectangle (4, 2) that is wider by ``beyond`` on each side."""
    return quad + beyond * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])


def prism(bottom: Points, z0: float, z1: float, rise: tuple[float, float] = (0.0, 0.0), top: Points | None = None) -> Solid:
    """A solid between two polygons (N, 2) of as many corners; without ``top``, walls are upright."""
    n = len(bottom)
    top = bottom if top is None else top
    points = np.concatenate([np.column_stack([ring, np.full(n, z)]) for ring, z in ((bottom, z0), (top, z1))])
    i = np.arange(n)
    k = (i + 1) % n
    walls = np.concatenate([np.stack([i, k, k + n], 1), np.stack([i, k + n, i + n], 1)])
    fan = np.arange(1, n - 1)
    floor = np.stack([0 * fan, fan + 1, fan], 1)
    roof = np.stack([0 * fan, fan, fan + 1], 1) + n
    return Solid(points, np.concatenate([walls, floor, roof]).astype(np.uint32), np.repeat(rise, n).astype(np.float64))


def roof(quad: Points, z: float, height: float, along_x: bool, hip: float = 0.0, rise: float = 1.0) -> Solid:
    """A pitched roof over a quad, its ridge along the quad's first side, or else along its second.

    ``hip``: distance of the ridge's ends from the gables, as a share of the ridge; 0 is a gable roof, 0.5 a pyramid.
    """
    a, b, c, d = quad if along_x else np.roll(quad, -1, 0)
    ends = 0.5 * (a + d), 0.5 * (b + c)
    ridge = [(1 - t) * ends[0] + t * ends[1] for t in (hip, 1 - hip)]
    points = np.array([*((*corner, z) for corner in (a, b, c, d)), *((*end, z + height) for end in ridge)])
    faces = [(0, 1, 5), (0, 5, 4), (2, 3, 4), (2, 4, 5), (1, 2, 5), (3, 0, 4), (0, 2, 1), (0, 3, 2)]
    return Solid(points, np.array(faces, np.uint32), np.full(6, rise))


def turned(profile: Sequence[tuple[float, float]], sides: int = 8) -> Solid:
    """A solid of revolution: rings of (radius, z) from below to above, around the z axis, with flat ends."""
    angles = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    circle = np.column_stack([np.cos(angles), np.sin(angles)])
    points = np.concatenate([np.column_stack([radius * circle, np.full(sides, z)]) for radius, z in profile])
    i = np.arange(sides)
    k = (i + 1) % sides
    faces = []
    for ring in range(len(profile) - 1):
        low, high = ring * sides, (ring + 1) * sides
        faces += [np.stack([i + low, k + low, k + high], 1), np.stack([i + low, k + high, i + high], 1)]
    fan = np.arange(1, sides - 1)
    faces += [np.stack([0 * fan, fan + 1, fan], 1), np.stack([0 * fan, fan, fan + 1], 1) + (len(profile) - 1) * sides]
    return Solid(points, np.concatenate(faces).astype(np.uint32), np.zeros(len(points)))


def post(x: float, y: float, width: float, z0: float, z1: float) -> Solid:
    """An upright square post around (x, y)."""
    h = 0.5 * width
    return prism(rectangle(x - h, y - h, x + h, y + h), z0, z1)

"""Start meshes of optimisations."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError


def even_sphere(rings: int = 40, radius: float = 1.0) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint32]]:
    """A closed sphere of 8 rings^2 triangles of equal area, not denser at the poles: vertices (V, 3) and faces (F, 3).

    From each pole to the equator, ring i of ``rings`` has 4 i vertices at height 1 - (i / rings)^2 of the unit sphere. 40 rings
    make 12,800 triangles and 6,402 vertices. Faces wind outward. Raises ShadowmapError unless ``rings`` is 1 to 1000.
    """
    if not 1 <= rings <= 1000:
        raise ShadowmapError(f"a sphere of {rings} rings: choose from 1 to 1000.")
    points = [np.array([[0.0, 1.0, 0.0]])]
    first = [0]
    for i in (*range(1, rings + 1), *range(rings - 1, 0, -1)):
        y = 1 - (i / rings) ** 2
        angle = 0.5 * np.pi * np.arange(4 * i) / i
        first.append(sum(len(p) for p in points))
        across = np.sqrt(1 - y * y)
        sign = 1.0 if len(points) <= rings else -1.0
        points.append(np.stack([across * np.sin(angle), np.full(4 * i, sign * y), across * np.cos(angle)], -1))
    first.append(sum(len(p) for p in points))
    points.append(np.array([[0.0, -1.0, 0.0]]))
    upper = [_band(first[i], i, first[i + 1], i + 1) for i in range(rings)]
    lower = [_band(first[2 * rings - i], i, first[2 * rings - i - 1], i + 1)[:, ::-1] for i in range(rings)]
    vertices = radius * np.concatenate(points)
    return vertices.astype(np.float32), np.concatenate(upper + lower).astype(np.uint32)


def _band(inner: int, i: int, outer: int, j: int) -> npt.NDArray[np.int64]:
    """Triangles between a ring of 4 i vertices (one if i is 0) and the next of 4 j = 4 (i + 1) vertices."""
    faces = []
    for quarter in range(4):
        a = [inner + (quarter * i + k) % max(4 * i, 1) for k in range(i + 1)]
        b = [outer + (quarter * j + k) % (4 * j) for k in range(j + 1)]
        faces += [(a[k], b[k], b[k + 1]) for k in range(i + 1)]
        faces += [(a[k], b[k + 1], a[k + 1]) for k in range(i)]
    return np.array(faces)

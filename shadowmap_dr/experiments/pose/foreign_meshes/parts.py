"""Parts of meshes: boxes, tubes, surfaces of revolution, plates with holes; how they are joined and turned."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
Mesh = tuple[Array, Array]


def joined(parts: Iterable[Mesh]) -> Mesh:
    """One mesh of several, (V, 3) vertices and (F, 3) faces, without common vertices."""
    vertices: list[Array] = []
    faces: list[Array] = []
    count = 0
    for points, corners in parts:
        vertices.append(np.asarray(points, np.float64))
        faces.append(np.asarray(corners, np.int64) + count)
        count += len(points)
    return np.concatenate(vertices), np.concatenate(faces)


def box(centre: Sequence[float] | Array, size: Sequence[float] | Array, turn: Array | None = None) -> Mesh:
    """A box of 12 triangles, turned by a matrix (3, 3) about its centre."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * np.asarray(size)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [corner for a, b, c, d in quads for corner in ((a, b, c), (a, c, d))]
    return corners @ (np.eye(3) if turn is None else turn).T + np.asarray(centre), np.array(faces)


def tube(path: Array, radius: float | Array, sides: int = 8, closed: bool = False) -> Mesh:
    """A tube around a path (n, 3), with flat ends unless it is closed. The radius may change along it."""
    path = np.asarray(path, np.float64)
    n = len(path)
    along = np.roll(path, -1, 0) - np.roll(path, 1, 0) if closed else np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    normal = np.cross(along[0], np.eye(3)[np.argmin(np.abs(along[0]))])
    rings = []
    angle = 2 * np.pi * np.arange(sides) / sides
    for k in range(n):
        normal = normal - (normal @ along[k]) * along[k]
        normal /= np.linalg.norm(normal)
        other = np.cross(along[k], normal)
        r = np.broadcast_to(radius, n)[k]
        rings.append(path[k] + r * (np.cos(angle)[:, None] * normal + np.sin(angle)[:, None] * other))
    vertices = np.concatenate(rings)
    faces = strips(n, sides, closed)
    if closed:
        return vertices, faces
    last = (n - 1) * sides
    caps = [(0, k + 1, k) for k in range(1, sides - 1)] + [(last, last + k, last + k + 1) for k in range(1, sides - 1)]
    return vertices, np.concatenate([faces, caps])


def rod(start: Sequence[float] | Array, end: Sequence[float] | Array, radius: float, sides: int = 8) -> Mesh:
    """A straight bar between two points."""
    return tube(np.array([start, end]), radius, sides)


def revolved(profile: Array, sides: int) -> Mesh:
    """A surface of revolution about the y axis of a profile (n, 2) of radii and heights, closed if the profile is."""
    angle = 2 * np.pi * np.arange(sides) / sides
    r, y = np.asarray(profile, np.float64).T
    rings = [np.stack([a * np.cos(angle), np.full(sides, h), a * np.sin(angle)], 1) for a, h in zip(r, y, strict=True)]
    return np.concatenate(rings), strips(len(r), sides, False)[:, ::-1]


def strips(rings: int, sides: int, closed: bool) -> Array:
    """Triangles (F, 3) between neighbouring rings of vertices."""
    i, j = np.meshgrid(np.arange(rings if closed else rings - 1), np.arange(sides), indexing="ij")
    a, b = i * sides + j, i * sides + (j + 1) % sides
    c, d = (i + 1) % rings * sides + j, (i + 1) % rings * sides + (j + 1) % sides
    return np.concatenate([np.stack([a, b, d], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)])


def turned(mesh: Mesh, x: float = 0, y: float = 0, z: float = 0, move: Sequence[float] = (0, 0, 0)) -> Mesh:
    """A mesh turned about x, then y, then z (degrees), then moved."""
    matrix = np.eye(3)
    for axis, degrees in ((0, x), (1, y), (2, z)):
        matrix = rotation(axis, degrees) @ matrix
    return mesh[0] @ matrix.T + np.asarray(move), mesh[1]


def rotation(axis: int, degrees: float) -> Array:
    """Matrix (3, 3) of a rotation about a coordinate axis."""
    s, c = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
    matrix, (a, b) = np.eye(3), ((axis + 1) % 3, (axis + 2) % 3)
    matrix[a, a] = matrix[b, b] = c
    matrix[b, a], matrix[a, b] = s, -s
    return matrix


def plate(cells: Sequence[str], thickness: float, sides: int = 24) -> Mesh:
    """A plate in the xy plane, of squares of side 1: ``#`` full, ``o`` and ``O`` with a small or a large hole, ``.`` none.

    Holes have rims: rings of 0.05 that stand out on both sides.
    """
    angle = 2 * np.pi * np.arange(sides) / sides + np.pi / 4
    unit = np.stack([np.cos(angle), np.sin(angle)], 1)
    square = 0.5 * unit / np.abs(unit).max(1, keepdims=True)
    parts = []
    h = thickness / 2
    for row, line in enumerate(cells):
        for column, cell in enumerate(line):
            at = np.array([column, -row, 0.0])
            if cell == "#":
                parts.append(box(at, (1, 1, thickness)))
            elif cell in "oO":
                hole = {"o": 0.22, "O": 0.38}[cell]
                loops = [(square, h), (unit * (hole + 0.05), h), (unit * (hole + 0.05), 2 * h), (unit * hole, 2 * h)]
                loops += [(loop, -z) for loop, z in reversed(loops)]
                points = np.concatenate([np.column_stack([loop, np.full(sides, z)]) for loop, z in loops]) + at
                parts.append((points, strips(len(loops), sides, True)))
    return joined(parts)

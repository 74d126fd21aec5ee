"""Triangle meshes of Mitsuba's analytic shapes, in the local space that the shape's ``to_world`` maps to the world.

Vertices lie on the surface. Texture coordinates follow Mitsuba's parametrisation of each shape, so textures line up; where the
parametrisation closes on itself (u = 0 and u = 1) vertices are doubled.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class LocalMesh:
    """positions (V, 3), normals (V, 3), texcoords (V, 2) float32 and faces (F, 3) uint32, local space, outward winding."""

    positions: np.ndarray
    normals: np.ndarray
    texcoords: np.ndarray
    faces: np.ndarray


def sphere(segments: int) -> LocalMesh:
    """Unit sphere, ``segments`` around the z axis and half as many from pole to pole; uv = (phi / 2 pi, theta / pi)."""
    rings = max(segments // 2, 2)
    u, v = _lattice(segments, rings)
    # A pole has one vertex for each triangle that ends there, with the u of the triangle's middle.
    u = np.where((v == 0) | (v == 1), u + 0.5 / segments, u)
    (x, y), theta = _circle(u), np.pi * v
    positions = np.stack([np.sin(theta) * x, np.sin(theta) * y, np.cos(theta)], -1)
    positions[v == 0] = (0, 0, 1)
    positions[v == 1] = (0, 0, -1)
    quads = _quads(segments, rings)
    # Outward: the direction of growing theta times that of growing phi points away from the centre.
    row = quads[:, 0] // (segments + 1)
    inner = quads[(row > 0) & (row < rings - 1)]
    faces = [quads[row == 0][:, [0, 1, 2]], inner[:, [0, 1, 2]], inner[:, [0, 2, 3]], quads[row == rings - 1][:, [0, 1, 3]]]
    return _mesh(positions, positions, np.stack([u, v], -1), np.concatenate(faces))


def disk(segments: int) -> LocalMesh:
    """Unit disk in the xy plane that faces +z, in rings; uv = (radius, phi / 2 pi)."""
    rings = max(segments // 8, 1)
    angle, radius = _lattice(segments, rings)
    # The centre has one vertex for each triangle that meets there, with the angle of the triangle's middle.
    angle = np.where(radius == 0, angle + 0.5 / segments, angle)
    x, y = _circle(angle)
    positions = np.stack([radius * x, radius * y, 0 * x], -1)
    normals = np.broadcast_to((0.0, 0.0, 1.0), positions.shape)
    quads = _quads(segments, rings)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[segments:, [0, 2, 3]]])
    return _mesh(positions, normals, np.stack([radius, angle], -1), faces)


def cylinder(segments: int) -> LocalMesh:
    """Unit cylinder around the z axis, z from 0 to 1, without caps; uv = (phi / 2 pi, z)."""
    u, z = _lattice(segments, 1)
    x, y = _circle(u)
    normals = np.stack([x, y, 0 * x], -1)
    positions = normals + np.stack([0 * z, 0 * z, z], -1)
    quads = _quads(segments, 1)
    return _mesh(positions, normals, np.stack([u, z], -1), np.concatenate([quads[:, [0, 2, 1]], quads[:, [0, 3, 2]]]))


def _lattice(columns: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """(columns + 1) x (rows + 1) points of the unit square, row by row."""
    second, first = np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij")
    return first.ravel(), second.ravel()


def _circle(turns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cosine and sine, equal to the last bit after a whole turn: otherwise the surface would be open there."""
    angle = 2 * np.pi * (turns % 1)
    return np.cos(angle), np.sin(angle)


def _quads(columns: int, rows: int) -> np.ndarray:
    """Lattice cells as corners (this, next row, next row and column, next column)."""
    row, column = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    corner = (row * (columns + 1) + column).ravel()
    return np.stack([corner, corner + columns + 1, corner + columns + 2, corner + 1], -1)


def _mesh(positions: np.ndarray, normals: np.ndarray, texcoords: np.ndarray, faces: np.ndarray) -> LocalMesh:
    positions, normals, texcoords = (np.ascontiguousarray(a, dtype=np.float32) for a in (positions, normals, texcoords))
    return LocalMesh(positions, normals, texcoords, np.ascontiguousarray(faces, dtype=np.uint32))

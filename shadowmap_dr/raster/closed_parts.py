"""Faces whose backs are invisible from outside the mesh, and a fast drawing order. Computed once on the host."""

from __future__ import annotations

import numpy as np

from .topology import Topology


def outward_faces(topology: Topology, positions: np.ndarray) -> np.ndarray:
    """Faces of the parts of a mesh that are closed and turned outwards (bool, F).

    A ray from outside meets the front of such a part before its back, so that backfaces need not be drawn.

    Args:
        topology: topology of the mesh.
        positions: (V, 3) vertices.

    A part is closed if each of its edges has exactly two faces, which run along it in opposite directions, and turned outwards
    if it encloses a positive volume.
    """
    faces, welded = (np.asarray(a.numpy(), np.int64).reshape(-1, 3) for a in (topology.faces, topology.welded))
    parts = np.asarray(topology.parts.numpy(), np.int64)
    count = int(welded.max()) + 1
    start, end = welded.ravel(), np.roll(welded, -1, 1).ravel()
    owner = np.repeat(parts, 3)
    there, uses = np.unique(start * count + end, return_counts=True)
    back = end * count + start
    slot = np.minimum(np.searchsorted(there, back), len(there) - 1)
    once = uses[np.searchsorted(there, start * count + end)] == 1
    fine = once & (there[slot] == back) & (uses[slot] == 1)
    closed = np.ones(topology.part_count, bool)
    closed[owner[~fine]] = False
    a, b, c = (np.asarray(positions, np.float64)[faces[:, k]] for k in range(3))
    # Volumes relative to a point of each part keep rounding errors small.
    first = np.zeros((topology.part_count, 3))
    first[parts] = a
    origin = first[parts]
    volume = np.bincount(parts, np.einsum("ij,ij->i", a - origin, np.cross(b - origin, c - origin)), topology.part_count)
    return (closed & (volume > 0))[parts]


# Directions in which normals are sorted.
_BINS = 24


def drawing_order(faces: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """An order of faces (F,) in which neighbours face the same way and have about the same size.

    Triangles are drawn in packets, each as slow as its largest triangle. With backface culling, packets that face away as a whole
    cost nothing.

    Args:
        faces: (F, 3) vertex indices.
        positions: (V, 3) vertices.
    """
    a, b, c = (np.asarray(positions, np.float64)[np.asarray(faces)[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    # Directions evenly spread over the sphere: a Fibonacci spiral.
    turn = np.arange(_BINS) + 0.5
    cosine, angle = 1 - 2 * turn / _BINS, np.pi * (1 + 5**0.5) * turn
    sine = np.sqrt(1 - cosine**2)
    directions = np.stack([sine * np.cos(angle), sine * np.sin(angle), cosine], 1)
    return np.lexsort((np.linalg.norm(normal, axis=1), (normal @ directions.T).argmax(1)))

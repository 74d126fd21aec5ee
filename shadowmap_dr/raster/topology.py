"""Edges of a triangle mesh and the vertices opposite to them, welded by position."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ._memory import device_array

#: Stands for "no second face" in :attr:`Topology.opposite`.
NO_VERTEX = 0xFFFFFFFF


@dataclass(frozen=True)
class Topology:
    """Edges of a mesh; constant for as long as its faces and the welding of its vertices are.

    Attributes:
        edges: ``UInt32`` (2 E,) vertices a and b of each edge.
        opposite: ``UInt32`` (2 E,) third vertices of the one or two faces at each edge, ``NO_VERTEX`` at a boundary. An edge of
            three or more faces stands once for each of them, as a boundary.
        count: number of edges E.
        faces, welded: ``UInt32`` (3 F,) vertices of the faces, as they are and with one number for each place.
        parts: ``UInt32`` (F,) a number for each face, the same for faces that are connected through common vertices.
        part_count: how many different numbers there are.
        beyond: ``UInt32`` (3 F,) for the edge from corner k to k + 1 of each face the third vertex of the face on its other side,
            ``NO_VERTEX`` where there is none or more than one.
        vertex_count: how many vertices there are at least: one more than the largest index.
    """

    edges: Any
    opposite: Any
    count: int
    faces: Any
    welded: Any
    parts: Any
    part_count: int
    beyond: Any
    vertex_count: int


def build_topology(faces: np.ndarray, positions: np.ndarray, dtype: type) -> Topology:
    """Find the edges of a mesh (on the host, once).

    Args:
        faces: (F, 3) vertex indices.
        positions: (V, 3) vertices. Vertices at the same place count as one: seams of texture coordinates or normals
            duplicate vertices, but are no boundaries of the surface.
        dtype: the ``UInt32`` type of the Dr.Jit backend in use.

    Degenerate faces (with two corners at the same place) are left out.
    """
    faces = np.asarray(faces).reshape(-1, 3).astype(np.int64)
    positions = np.ascontiguousarray(np.asarray(positions, dtype=np.float32).reshape(-1, 3)) + np.float32(0)  # -0 -> 0
    if faces.size == 0:
        raise ValueError("faces are empty; a topology needs at least one triangle")
    if faces.min() < 0 or faces.max() >= len(positions):
        raise ValueError(f"faces refer to vertices {faces.min()}..{faces.max()}, but there are {len(positions)}")
    _, weld = np.unique(positions.view([("", np.float32)] * 3).ravel(), return_inverse=True)
    welded = weld[faces]
    parts, part_count = _parts(welded)
    flat = [device_array(dtype, t) for t in (faces, welded, parts)]
    proper = (welded != np.roll(welded, 1, 1)).all(1)
    where = np.flatnonzero(proper)
    beyond = np.full(3 * len(proper), NO_VERTEX)
    vertex_count = int(faces.max()) + 1
    faces, welded = faces[proper], welded[proper]

    a, b, opposite = (np.concatenate([faces[:, (k + s) % 3] for k in range(3)]) for s in (0, 1, 2))
    wa, wb = (np.concatenate([welded[:, (k + s) % 3] for k in range(3)]) for s in (0, 1))
    key = np.minimum(wa, wb) * len(positions) + np.maximum(wa, wb)
    order = np.argsort(key, kind="stable")
    _, first, size = np.unique(key[order], return_index=True, return_counts=True)

    pair = order[first[size == 2]]
    partner = order[first[size == 2] + 1]
    alone = order[np.repeat(size != 2, size)]
    edges = np.concatenate([pair, alone])
    slot = np.concatenate([3 * where + k for k in range(3)])
    beyond[slot[pair]], beyond[slot[partner]] = opposite[partner], opposite[pair]
    second = np.concatenate([opposite[partner], np.full(len(alone), NO_VERTEX)])
    return Topology(
        device_array(dtype, np.stack([a[edges], b[edges]], 1)),
        device_array(dtype, np.stack([opposite[edges], second], 1)),
        len(edges),
        *flat,
        part_count,
        device_array(dtype, beyond),
        vertex_count,
    )


def _parts(welded: np.ndarray) -> tuple[np.ndarray, int]:
    """Number of the connected part of each face, from 0 on, and how many there are.

    All vertices point to themselves at first. Those that the corners of a face point to are redirected to the lowest of them and
    chains are cut short, until nothing changes: as many rounds as the logarithm of a part's size, about.
    """
    target = np.arange(welded.max() + 1)
    while True:
        corners = target[welded]
        lowest = corners.min(1)
        if (corners == lowest[:, None]).all():
            break
        np.minimum.at(target, corners.ravel(), np.repeat(lowest, 3))
        while (target != target[target]).any():
            target = target[target]
    _, parts = np.unique(lowest, return_inverse=True)
    return parts, int(parts.max()) + 1

"""Edges of a triangle mesh and the vertices opposite to them, welded by position."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from ._memory import device_array
from .seams import NO_VERTEX, Seams


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
        seams: where shapes border on each other, or None if they do nowhere.
        veils: ``Bool`` (F,), faces that one may see through, or None if there are none. Where one does, their edges hide nothing.
        owners: ``UInt32`` (2 E,) faces of each edge, twice the same where they are of one shape; None without ``veils``.
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
    seams: Seams | None = None
    veils: Any = None
    owners: Any = None


def build_topology(
    faces: np.ndarray,
    positions: np.ndarray,
    dtype: type,
    shapes: np.ndarray | None = None,
    veils: np.ndarray | None = None,
) -> Topology:
    """Find the edges of a mesh (on the host, once).

    Args:
        faces: (F, 3) vertex indices.
        positions: (V, 3) vertices. Vertices at the same place count as one: seams of texture coordinates or normals
            duplicate vertices, but are no boundaries of the surface.
        dtype: the ``UInt32`` type of the Dr.Jit backend in use.
        shapes: (V,) number of the shape that each vertex belongs to. Shapes may move apart: where they border on each other, and
            nowhere else, their faces have common edges, but they are parts of their own. :func:`parted` tells which still do.
        veils: (F,) which faces one may see through.

    Degenerate faces (with two corners at the same place) are left out.

    Raises:
        ValueError: arrays of other shapes, no faces, an index out of range.
    """
    faces = _in_threes("faces", "F", np.asarray(faces)).astype(np.int64)
    positions = np.ascontiguousarray(_in_threes("positions", "V", np.asarray(positions, np.float32))) + np.float32(0)  # -0 -> 0
    if faces.size == 0:
        raise ValueError("faces are empty; a topology needs at least one triangle")
    if faces.min() < 0 or faces.max() >= len(positions):
        raise ValueError(f"faces refer to vertices {faces.min()}..{faces.max()}, but there are {len(positions)}")
    _, weld = np.unique(positions.view([("", np.float32)] * 3).ravel(), return_inverse=True)
    welded = weld[faces]
    owners = np.zeros(len(positions), np.int64) if shapes is None else np.asarray(shapes, np.int64)
    places = welded if shapes is None else welded * (owners.max() + 1) + owners[faces]
    parts, part_count = _parts(np.unique(places, return_inverse=True)[1].reshape(-1, 3))
    flat = [device_array(dtype, t) for t in (faces, welded, parts)]
    proper = (welded != np.roll(welded, 1, 1)).all(1)
    where = np.flatnonzero(proper)
    beyond = np.full(3 * len(proper), NO_VERTEX)
    vertex_count = int(faces.max()) + 1
    faces, welded = faces[proper], welded[proper]

    a, b, opposite = (np.concatenate([faces[:, (k + s) % 3] for k in range(3)]) for s in (0, 1, 2))
    wa, wb = (np.concatenate([welded[:, (k + s) % 3] for k in range(3)]) for s in (0, 1))
    key = np.minimum(wa, wb) * len(positions) + np.maximum(wa, wb)
    # Two faces of one shape, or else the only ones of two.
    pair, partner, alone = _pairs(np.arange(len(key)), key * (owners.max() + 1) + owners[a])
    one, two, alone = _pairs(alone, key)
    slot = np.concatenate([3 * where + k for k in range(3)])
    for mine, other in ((pair, partner), (one, two)):
        beyond[slot[mine]], beyond[slot[other]] = opposite[other], opposite[mine]
    # Those between shapes come last, and each of them again, without extent, as an edge of its other face.
    edges = np.concatenate([pair, alone, one])
    second = np.concatenate([opposite[partner], np.full(len(alone), NO_VERTEX), opposite[two]])
    ends, thirds = np.stack([a[edges], b[edges]], 1), np.stack([opposite[edges], second], 1)
    seams, owner = None, np.stack([slot[edges], np.concatenate([slot[pair], slot[alone], slot[two]])], 1) // 3
    if len(one):
        other = np.stack([a[two], b[two]], 1)
        other = np.where((wa[one] == wa[two])[:, None], other, other[:, ::-1])
        seams = Seams.of(dtype, ends[-len(one) :], other, thirds[-len(one) :], np.stack([slot[one], slot[two]], 1))
        ends = np.concatenate([ends, np.zeros_like(other)])
        thirds = np.concatenate([thirds, np.full_like(other, NO_VERTEX)])
        owner = np.concatenate([owner, np.stack([slot[two], slot[two]], 1) // 3])
    return Topology(
        device_array(dtype, ends),
        device_array(dtype, thirds),
        len(ends),
        *flat,
        part_count,
        device_array(dtype, beyond),
        vertex_count,
        seams,
        *(None, None) if veils is None else (device_array(dr.mask_t(dtype), veils), device_array(dtype, owner)),
    )


def _in_threes(name: str, count: str, values: np.ndarray) -> np.ndarray:
    if (values.ndim == 2 and values.shape[1] == 3) or (values.ndim == 1 and values.size % 3 == 0):
        return values.reshape(-1, 3)
    raise ValueError(f"{name} have shape {values.shape}; expected ({count}, 3)")


def _pairs(index: np.ndarray, key: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Those of ``index`` whose key exactly one other has, too (the first and the second of each two), and the rest."""
    order = index[np.argsort(key[index], kind="stable")]
    _, first, size = np.unique(key[order], return_index=True, return_counts=True)
    return order[first[size == 2]], order[first[size == 2] + 1], order[np.repeat(size != 2, size)]


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

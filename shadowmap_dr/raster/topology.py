"""Edges of a triangle mesh and the vertices opposite to them, welded by position."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import numpy as np
import numpy.typing as npt

from ..jit.arrays import device_array
from ..jit.types import Bool, UInt32
from .adjacency import EdgeBlocks, InnerEdges, across_edges, after, edge_keys, pairs_of, parts_of, third
from .types import NO_VERTEX
from .welding import Index, Places, copies_of, weld


@dataclass(frozen=True)
class Seams:
    """Seams: edges that faces of two shapes share, S of them.

    They are the last 2 S edges of a :class:`Topology`: the seams, then for each seam a placeholder without extent, which becomes
    the edge of the second shape when the shapes move apart.

    Attributes:
        mine, other: (2 S,) ends of each seam, as vertices of its first and of its second face, in the same order.
        opposite: (2 S,) third vertices of both faces.
        slots: (2 S,) indices of the edge in :attr:`Topology.beyond` for both faces.
        count: S.
    """

    mine: UInt32
    other: UInt32
    opposite: UInt32
    slots: UInt32
    count: int

    @classmethod
    def of(cls, dtype: type[UInt32], mine: np.ndarray, other: np.ndarray, opposite: np.ndarray, slots: np.ndarray) -> Seams:
        """From NumPy arrays (S, 2) each."""
        a, b, c, d = (device_array(dtype, array) for array in (mine, other, opposite, slots))
        return cls(a, b, c, d, len(mine))


@dataclass(frozen=True)
class Topology:
    """Edges of a mesh. They depend on its faces and on the welding of its vertices, but not on where these move.

    Attributes:
        edges: (2 E,) vertices a and b of each edge.
        opposite: (2 E,) third vertices of the one or two faces at each edge, ``NO_VERTEX`` at a boundary. An edge of three or
            more faces is listed once for each of them, as a boundary.
        count: number of edges E.
        faces, welded: (3 F,) vertices of the faces: the original ones, and with each replaced by the first vertex at its place.
        parts: (F,) part of each face. Faces that are connected through common vertices are one part.
        part_count: number of parts.
        beyond: (3 F,) for the edge from corner k to k + 1 of each face, the third vertex of the face on its other side,
            ``NO_VERTEX`` if there is none or more than one.
        vertex_count: least number of vertices: one more than the largest index.
        seams: edges that two shapes share, or None if there are none.
        see_through_faces: (F,) mask of faces that may be see-through, or None if there are none. Where they are, their edges
            hide nothing.
        owners: (2 E,) faces of each edge, twice the same at an edge of one shape; None without ``see_through_faces``.
    """

    RECORDED_OFTEN: ClassVar[bool] = True  # see `jit.frozen.take_apart`

    edges: UInt32
    opposite: UInt32
    count: int
    faces: UInt32
    welded: UInt32
    parts: UInt32
    part_count: int
    beyond: UInt32
    vertex_count: int
    seams: Seams | None = None
    see_through_faces: Bool | None = None
    owners: UInt32 | None = None


def build_topology(
    faces: np.ndarray,
    positions: np.ndarray,
    dtype: type[UInt32],
    shapes: np.ndarray | None = None,
    see_through_faces: np.ndarray | None = None,
) -> Topology:
    """Find the edges of a mesh (on the host, once).

    Args:
        faces: (F, 3) vertex indices.
        positions: (V, 3) vertices. Vertices at the same place count as one: seams of texture coordinates or normals
            duplicate vertices, but are no boundaries of the surface.
        dtype: the ``UInt32`` type of the Dr.Jit backend in use.
        shapes: (V,) index of the shape that each vertex belongs to. Faces of two shapes share the edges at which the shapes touch
            now, but belong to different parts, for shapes may move apart (:func:`detach_moved_seams`).
        see_through_faces: (F,) mask of faces that may be see-through.

    Degenerate faces (with two corners at the same place) are left out.

    Raises:
        ValueError: arrays of other shapes, no faces, an index out of range.
    """
    faces = _in_threes("faces", "F", faces, "iu")
    with np.errstate(over="ignore"):
        positions = _in_threes("positions", "V", positions, "fiu").astype(np.float32) + np.float32(0)  # -0 -> 0
    if faces.size == 0:
        raise ValueError("faces are empty; a topology needs at least one triangle")
    low, high = int(faces.min()), int(faces.max())
    if low < 0 or high >= len(positions):
        raise ValueError(f"faces refer to vertices {low}..{high}, but there are {len(positions)}")
    faces = np.ascontiguousarray(faces, np.uint32)
    owners = None if shapes is None else np.asarray(shapes)
    vertices = weld(positions, owners)
    copies = copies_of(faces, vertices.own, owners)
    corners, places = faces.ravel(), vertices.place.astype(np.uint32)[faces.ravel()]
    inner = [InnerEdges.of(group, corners, vertices.own) for group in copies]
    alone = np.concatenate([group.repeated(edges.alone, 3) for group, edges in zip(copies, inner, strict=True)])
    one, two, alone = pairs_of(alone, edge_keys(vertices.place, corners, alone))
    # Of outlines that coincide in an image, the first edge counts. Sort edges by position, so that this does not depend on the
    # order of vertices in a file.
    alone, chosen = (_by_place(halves, corners, positions) for halves in (alone, one))
    one, two = chosen, two[np.searchsorted(one, chosen)]
    # Seams come last, each followed by its placeholder (see `Seams`).
    blocks, rest = EdgeBlocks.of(copies, inner), np.concatenate([alone, one])
    ends = np.stack([corners[rest], corners[after(rest)]], 1)
    across = np.concatenate([np.full(len(alone), NO_VERTEX, np.uint32), third(corners, two)])
    thirds = np.stack([third(corners, rest), across], 1)
    seams = None
    if len(one):
        other = np.stack([corners[two], corners[after(two)]], 1)
        other = np.where((places[one] == vertices.place[other[:, 0]])[:, None], other, other[:, ::-1])
        seams = Seams.of(dtype, ends[-len(one) :], other, thirds[-len(one) :], np.stack([one, two], 1))
        ends = np.concatenate([ends, np.zeros_like(other)])
        thirds = np.concatenate([thirds, np.full_like(other, NO_VERTEX)])
    veils = owners_of_edges = None
    if see_through_faces is not None:
        owner = np.stack([np.concatenate([rest, two]), np.concatenate([alone, two, two])], 1) // 3
        inner_owners = [np.stack([edges.pair, edges.partner], 1) // 3 for edges in inner]
        veils = device_array(dr.mask_t(dtype), see_through_faces)
        owners_of_edges = blocks.buffer(dtype, inner_owners, owner, "faces")
    parts, part_count = parts_of(dtype, copies, corners, vertices.own)
    return Topology(
        edges=blocks.buffer(dtype, [edges.ends for edges in inner], ends, "vertices"),
        opposite=blocks.buffer(dtype, [edges.thirds for edges in inner], thirds, "vertices"),
        count=blocks.count + len(ends),
        faces=device_array(dtype, corners),
        welded=device_array(dtype, places),
        parts=parts,
        part_count=part_count,
        beyond=across_edges(dtype, copies, inner, corners, one, two),
        vertex_count=high + 1,
        seams=seams,
        see_through_faces=veils,
        owners=owners_of_edges,
    )


def _by_place(halves: Index, corners: np.ndarray, positions: np.ndarray) -> Index:
    """Half-edges (given ascending) in the order of the positions of their ends; the order of equal ones is kept."""
    if not len(halves):
        return halves
    marked = np.zeros(len(positions), bool)
    marked[corners[halves]] = marked[corners[after(halves)]] = True
    used = np.flatnonzero(marked)
    rank = np.zeros(len(positions), np.int64)
    rank[used] = Places.of(positions[used]).rank
    return halves[np.argsort(edge_keys(rank, corners, halves), kind="stable")]


def _in_threes(name: str, count: str, given: npt.ArrayLike, kinds: str) -> np.ndarray:
    """Rows of three numbers of the kinds ``kinds`` (``np.dtype.kind``)."""
    try:
        values = np.asarray(given)
    except ValueError:
        raise ValueError(f"{name} are no array; expected ({count}, 3)") from None
    if values.size and values.dtype.kind not in kinds:
        raise ValueError(f"{name} hold {values.dtype}; expected {'integers' if kinds == 'iu' else 'numbers'} ({count}, 3)")
    if (values.ndim == 2 and values.shape[1] == 3) or (values.ndim == 1 and values.size % 3 == 0):
        return values.reshape(-1, 3)
    raise ValueError(f"{name} have shape {values.shape}; expected ({count}, 3)")

"""Common edges and vertices of the faces of a mesh (on the host).

Half-edge 3 * face + corner leads from that corner to the next one. Copies of a shape are adjacent alike, so that only the first
copy is processed (:class:`~shadowmap_dr.raster.welding.Copies`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..jit.types import UInt32
from .index_buffer import IndexBufferBuilder
from .types import NO_VERTEX
from .welding import Copies, Index, runs

Vertices = npt.NDArray[np.uint32]


@dataclass(frozen=True)
class InnerEdges:
    """Edges of the first copy of a shape. Degenerate faces (two corners at the same place) are left out.

    Attributes:
        pair, partner: (P,) first and second half-edge of each edge at which exactly two faces meet.
        alone: all other half-edges.
        ends, thirds: (P, 2) vertices of the paired edges, and third vertices of both faces.
    """

    pair: Index
    partner: Index
    alone: Index
    ends: Vertices
    thirds: Vertices

    @classmethod
    def of(cls, copies: Copies, corners: Vertices, own: Index) -> InnerEdges:
        """Find the edges.

        Args:
            copies: copies of a shape.
            corners: (3 F,) vertices of all faces.
            own: (V,) as in :class:`~shadowmap_dr.raster.welding.Welded`.
        """
        half = copies.halves
        welded = own[corners[half]].reshape(-1, 3)
        half = half[np.repeat((welded != welded[:, [1, 2, 0]]).all(1), 3)]
        pair, partner, alone = pairs_of(half, edge_keys(own, corners, half))
        # An edge takes the vertices of the face with the lower corner: of several vertices at a place, these receive gradients.
        ranks = [h % 3 * len(corners) + h // 3 for h in (pair, partner)]
        pair, partner = np.where(ranks[0] < ranks[1], [pair, partner], [partner, pair])
        ends = np.stack([corners[pair], corners[after(pair)]], 1)
        thirds = np.stack([third(corners, pair), third(corners, partner)], 1)
        return cls(pair, partner, alone, ends, thirds)


def after(halves: Index) -> Index:
    """The next half-edge of the same face, for each half-edge."""
    return halves + np.where(halves % 3 == 2, -2, 1)


def third(corners: Vertices, halves: Index) -> Vertices:
    """The third vertex of the face, for each half-edge."""
    return corners[halves + np.where(halves % 3 == 0, 2, -1)]


def edge_keys(welded: Index, corners: Vertices, halves: Index) -> Index:
    """One number for each edge, in either direction. ``welded`` (V,): the same number for vertices that count as one."""
    start, end = welded[corners[halves]], welded[corners[after(halves)]]
    return np.minimum(start, end) * len(welded) + np.maximum(start, end)


def pairs_of(halves: Index, keys: Index) -> tuple[Index, Index, Index]:
    """(first, second, other half-edges): pairs of half-edges that alone share a key, and all others, ascending."""
    if not len(halves):
        return halves, halves, halves
    order = np.argsort(keys)
    first, size = runs(keys[order])
    double = first[size == 2]
    two = np.sort(np.stack([halves[order[double]], halves[order[double + 1]]]), 0)
    two = two[:, np.argsort(two[0])]
    return two[0], two[1], np.sort(halves[order[np.repeat(size != 2, size)]])


@dataclass(frozen=True)
class EdgeBlocks:
    """Order of the edges of all copies: by the lower half-edge of each edge, as if no shape were a copy.

    Attributes:
        copies: groups of copies.
        places: for each group, the first index of each copy's edges (copies,); for shapes without a copy, the index of each edge.
        count: number of all edges.
    """

    copies: Sequence[Copies]
    places: list[Index]
    count: int

    @classmethod
    def of(cls, copies: Sequence[Copies], inner: Sequence[InnerEdges]) -> EdgeBlocks:
        """Order the edges of groups of copies; ``inner`` holds the edges of each group."""
        groups = list(zip(copies, inner, strict=True))
        starts = np.concatenate([group.faces for group in copies if len(group.faces) > 1] or [np.zeros(0, np.int64)])
        sizes = [np.full(len(group.faces), len(edges.pair)) for group, edges in groups if len(group.faces) > 1]
        order = np.argsort(starts)
        before = np.concatenate([[0], np.cumsum(np.concatenate(sizes or [np.zeros(0, np.int64)])[order])])
        lower = [np.minimum(edges.pair, edges.partner) for group, edges in groups if len(group.faces) == 1]
        single = np.concatenate(lower or [np.zeros(0, np.int64)])
        places = []
        for group, edges in groups:
            if len(group.faces) == 1:
                places.append(np.arange(len(edges.pair)) + before[np.searchsorted(3 * starts[order], single, "right")])
            else:
                places.append(before[np.searchsorted(starts[order], group.faces)] + np.searchsorted(single, 3 * group.faces))
        return cls(copies, places, len(single) + int(before[-1]))

    def buffer(
        self, dtype: type[UInt32], values: Sequence[npt.NDArray[np.integer[Any]]], rest: npt.NDArray[np.integer[Any]], kind: str
    ) -> UInt32:
        """Indices of all edges, then ``rest`` (R, 2): ``dtype`` (2 (count + R),).

        ``values``: for the edges (E, 2) of the first copy of each group, indices of ``vertices`` or ``faces`` (``kind``), which
        are shifted for each copy.
        """
        buffer = IndexBufferBuilder(dtype, 2 * (self.count + len(rest)))
        for group, places, own in zip(self.copies, self.places, values, strict=True):
            if len(group.faces) == 1:
                buffer.put((2 * places[:, None] + np.arange(2)).ravel(), own.ravel())
            else:
                first = group.vertices if kind == "vertices" else group.faces
                buffer.repeat(own.ravel(), 2 * places, first - first[0])
        buffer.put(2 * self.count + np.arange(2 * len(rest)), rest.ravel())
        return buffer.build()


def across_edges(
    dtype: type[UInt32], copies: Sequence[Copies], inner: Sequence[InnerEdges], corners: Vertices, one: Index, two: Index
) -> UInt32:
    """``Topology.beyond``: the third vertex of the face on the other side of each half-edge, ``dtype`` (3 F,).

    ``inner``: edges of each group of copies. ``one``, ``two``: half-edges of the edges between shapes.
    """
    buffer = IndexBufferBuilder(dtype, len(corners))
    for group, edges in zip(copies, inner, strict=True):
        halves = np.concatenate([edges.pair, edges.partner])
        numbers = np.concatenate([edges.thirds[:, 1], edges.thirds[:, 0]])
        if len(group.faces) == 1:
            buffer.put(halves, numbers)
        else:
            own = np.full(3 * len(group.rows), NO_VERTEX, np.uint32)
            own[halves - 3 * group.faces[0]] = numbers
            buffer.repeat(own, 3 * group.faces, group.vertices - group.vertices[0])
    buffer.put(one, third(corners, two))
    buffer.put(two, third(corners, one))
    return buffer.build()


def parts_of(dtype: type[UInt32], copies: Sequence[Copies], corners: Vertices, own: Index) -> tuple[UInt32, int]:
    """Number of the connected part of each face, from 0 on (``dtype`` (F,)), and how many there are.

    Other arguments as for :meth:`InnerEdges.of`.
    """
    parts, done = IndexBufferBuilder(dtype, len(corners) // 3), 0
    for group in copies:
        welded = np.unique(own[corners[group.halves]], return_inverse=True)[1].reshape(-1, 3)
        local, count = _connected(welded)
        if len(group.faces) == 1:
            parts.put(group.rows, local + done)
        else:
            parts.repeat(local + done, group.faces, count * np.arange(len(group.faces)))
        done += count * len(group.faces)
    return parts.build(), done


def _connected(welded: Index) -> tuple[Index, int]:
    """(index of the connected part of each face (F, 3), number of parts).

    Pointer jumping: all vertices point to themselves at first. The targets of a face's corners are redirected to the lowest of
    them, and chains are shortened, until nothing changes. The number of rounds is about the logarithm of a part's size.
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

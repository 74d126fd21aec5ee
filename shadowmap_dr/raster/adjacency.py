"""Common edges and vertices of the faces of a mesh (on the host).

Half-edges are counted as 3 * face + corner: each leads from that corner to the next one. What copies of a shape have in common is
found out for the first one only (:class:`~shadowmap_dr.raster.welding.Copies`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .index_buffer import IndexBufferBuilder
from .types import NO_VERTEX
from .welding import Copies, Index, runs

Vertices = npt.NDArray[np.uint32]


@dataclass(frozen=True)
class InnerEdges:
    """Edges of the first of some copies. Degenerate faces (two corners at the same place) are left out.

    Attributes:
        pair, partner: half-edges (P,) at which exactly two faces meet: the first and the second of each.
        alone: all other half-edges.
        ends, thirds: (P, 2) vertices of the edges, and third vertices of both faces.
    """

    pair: Index
    partner: Index
    alone: Index
    ends: Vertices
    thirds: Vertices

    @classmethod
    def of(cls, copies: Copies, corners: Vertices, own: Index) -> InnerEdges:
        """Find them.

        Args:
            copies: of a shape.
            corners: (3 F,) vertices of all faces.
            own: (V,) as in :class:`~shadowmap_dr.raster.welding.Welded`.
        """
        half = copies.halves
        welded = own[corners[half]].reshape(-1, 3)
        half = half[np.repeat((welded != welded[:, [1, 2, 0]]).all(1), 3)]
        pair, partner, alone = pairs_of(half, edge_keys(own, corners, half))
        # Which face's vertices an edge has, and so which ones of several at a place receive its gradients: the lower corner's.
        ranks = [h % 3 * len(corners) + h // 3 for h in (pair, partner)]
        pair, partner = np.where(ranks[0] < ranks[1], [pair, partner], [partner, pair])
        ends = np.stack([corners[pair], corners[after(pair)]], 1)
        thirds = np.stack([third(corners, pair), third(corners, partner)], 1)
        return cls(pair, partner, alone, ends, thirds)


def after(halves: Index) -> Index:
    """The half-edges that follow these in their faces."""
    return halves + np.where(halves % 3 == 2, -2, 1)


def third(corners: Vertices, halves: Index) -> Vertices:
    """The vertices of the faces of half-edges that are not theirs."""
    return corners[halves + np.where(halves % 3 == 0, 2, -1)]


def edge_keys(welded: Index, corners: Vertices, halves: Index) -> Index:
    """One number for each edge, whichever way it runs. ``welded`` (V,): one number for all vertices that count as one."""
    start, end = welded[corners[halves]], welded[corners[after(halves)]]
    return np.minimum(start, end) * len(welded) + np.maximum(start, end)


def pairs_of(halves: Index, keys: Index) -> tuple[Index, Index, Index]:
    """Those whose key exactly one other has, too (the first and the second of each two), and the rest, ascending."""
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
    """An order of the edges of copies: by the lower half-edge of each, as if no shape were a copy.

    Attributes:
        copies: as for :func:`parts_of`.
        places: for each group of copies where the edges of each copy begin (copies,); for shapes without a copy where each edge
            lies.
        count: of all edges.
    """

    copies: Sequence[Copies]
    places: list[Index]
    count: int

    @classmethod
    def of(cls, copies: Sequence[Copies], inner: Sequence[InnerEdges]) -> EdgeBlocks:
        """``inner``: edges of each group."""
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
        self, dtype: type, values: Sequence[npt.NDArray[np.integer[Any]]], rest: npt.NDArray[np.integer[Any]], kind: str
    ) -> Any:
        """Numbers of all edges and of those that come last, ``rest`` (R, 2): ``dtype`` (2 (count + R),).

        ``values``: for the edges (E, 2) of the first copy of each group. ``kind``: ``vertices`` or ``faces``; the numbers of
        copies differ by that of their first one.
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
    dtype: type, copies: Sequence[Copies], inner: Sequence[InnerEdges], corners: Vertices, one: Index, two: Index
) -> Any:
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


def parts_of(dtype: type, copies: Sequence[Copies], corners: Vertices, own: Index) -> tuple[Any, int]:
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
    """Number of the connected part of each face (F, 3), from 0 on, and how many there are.

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

"""Which faces of a mesh have edges and vertices in common (on the host).

Half-edges are counted as 3 * face + corner: each leads from that corner to the next one. What copies of a shape have in common is
found out for the first one only (:class:`~shadowmap_dr.raster.welding.Copies`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .welding import Copies, Index, Places, runs

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
class EdgeOrder:
    """An order of edges that depends on where they are, before all else.

    ``places``: of the vertices; ``corners``, ``shapes``: as for :meth:`InnerEdges.of` and ``weld``.
    """

    places: Places
    corners: Vertices
    shapes: Index | None

    def __call__(self, halves: Index) -> Index:
        """The order of edges, given a half-edge of each: by their ends' places, then by shape, corner and face."""
        keys = edge_keys(self.places.rank, self.corners, halves)
        order, several = _nearly_ordered(keys)
        # Few edges lie on one another: only they are sorted by more than their places.
        tied = order[several]
        if len(tied):
            columns = [halves[tied] // 3, halves[tied] % 3, keys[tied]]
            if self.shapes is not None:
                columns.insert(2, self.shapes[self.corners[halves[tied]]])
            order[several] = tied[np.lexsort(columns)]
        return order


def _nearly_ordered(keys: Index) -> tuple[Index, npt.NDArray[np.bool_]]:
    """(an order of keys (K,) >= 0, places in it whose keys are equal to a neighbour's but for their last bits).

    Keys and their numbers are sorted as one number of 64 bits each, which is several times as fast as `numpy.argsort`. It has the
    first bits of keys only where there is no room for all.
    """
    if not len(keys):
        return keys, np.zeros(0, bool)
    bits = len(keys).bit_length()
    lost = max(0, int(keys.max()).bit_length() + bits - 64)
    both = keys.astype(np.uint64) >> np.uint64(lost) << np.uint64(bits) | np.arange(len(keys), dtype=np.uint64)
    both.sort()
    order = (both & np.uint64((1 << bits) - 1)).astype(np.int64)
    both >>= np.uint64(bits)
    equal = both[1:] == both[:-1]
    several = np.zeros(len(keys), bool)
    several[1:] = equal
    several[:-1] |= equal
    return order, several


def parts_of(copies: Sequence[Copies], corners: Vertices, own: Index) -> tuple[Index, int]:
    """Number of the connected part of each face, from 0 on, and how many there are. Arguments as for :meth:`InnerEdges.of`."""
    parts, done = np.empty(len(corners) // 3, np.uint32), 0
    for group in copies:
        welded = np.unique(own[corners[group.halves]], return_inverse=True)[1].reshape(-1, 3)
        local, count = _connected(welded)
        parts[group.rows] = local + done
        group.fill(parts, count * np.arange(len(group.faces)))
        done += count * len(group.faces)
    return parts, done


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

"""Vertices at the same place, and shapes that are copies of each other but for where they are (on the host)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Index = npt.NDArray[np.int64]

# Odd numbers without a pattern, by which coordinates are mixed.
_MIXERS = tuple(np.uint32(number) for number in (0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D))


@dataclass(frozen=True)
class Welded:
    """Vertices that count as one, V of them.

    place  (V,) the first vertex at each one's place
    own    (V,) the first vertex of the same shape there
    """

    place: Index
    own: Index


@dataclass(frozen=True)
class Places:
    """Places of vertices, in the order of x, then y, then z.

    rank   (V,) of each vertex's place, from 0 on: the same for vertices at the same place, to the last bit
    order  (V,) the vertices, ascending by rank
    """

    rank: Index
    order: Index

    @classmethod
    def of(cls, positions: npt.NDArray[np.float32]) -> Places:
        """For vertices (V, 3). Sorts whole numbers, which is several times as fast as `numpy.lexsort`."""
        bits = np.ascontiguousarray(positions).view(np.uint32)
        # Ordered as the numbers are.
        x, y, z = np.where(bits >> np.uint32(31), ~bits, bits | np.uint32(1 << 31)).astype(np.uint64).T
        shift = np.uint64(32)
        order, before = _sorted(x << shift | y)
        again, rank = _sorted(before.astype(np.uint64) << shift | z[order])
        order = order[again]
        ranks = np.empty(len(order), np.int64)
        ranks[order] = rank
        return cls(ranks, order)


def weld(positions: npt.NDArray[np.float32], shapes: npt.NDArray[np.integer[Any]] | None) -> Welded:
    """Find the vertices (V, 3) at the same place, to the last bit. ``shapes`` (V,): whose they are, None if all are of one."""
    place = np.arange(len(positions))
    some = _perhaps_shared(positions)
    located = Places.of(positions[some])
    order = some[located.order]
    starts, sizes = runs(located.rank[located.order])
    shared = order[np.repeat(sizes > 1, sizes)]
    if not len(shared):
        return Welded(place, place)
    # Of equal vertices the first one: ``some`` ascends, but the order within a run is any.
    place[order] = np.repeat(np.minimum.reduceat(order, starts), sizes)
    if shapes is None:
        return Welded(place, place)
    own = np.arange(len(place))
    key = place[shared] * (int(shapes.max()) + 1) + shapes[shared].astype(np.int64)
    order = np.argsort(key)
    starts, sizes = runs(key[order])
    own[shared[order]] = np.repeat(np.minimum.reduceat(shared[order], starts), sizes)
    return Welded(place, own)


def _perhaps_shared(positions: npt.NDArray[np.float32]) -> Index:
    """Vertices that may lie where another one does, ascending: all that do, and few others.

    Sums of their bits are compared. Sorting plain numbers is many times as fast as finding their order.
    """
    bits = np.ascontiguousarray(positions).view(np.uint32)
    # Multiplication moves bits upwards only, and coordinates on a grid have zeros as their last bits.
    mixed = (bits ^ bits >> np.uint32(16)) @ np.array(_MIXERS)
    mixed ^= mixed >> np.uint32(15)
    ascending = np.sort(mixed)
    several = ascending[1:][ascending[1:] == ascending[:-1]]
    if not len(several):
        return np.zeros(0, np.int64)
    # A table of the last bits sorts most of them out.
    last = np.uint32((1 << 20) - 1)
    marked = np.zeros(1 << 20, bool)
    marked[several & last] = True
    found = np.flatnonzero(marked[mixed & last])
    slots = np.minimum(np.searchsorted(several, mixed[found]), len(several) - 1)
    return found[several[slots] == mixed[found]]


def runs(values: npt.NDArray[np.generic]) -> tuple[Index, Index]:
    """(start, length) of each run of equal numbers."""
    starts = np.flatnonzero(np.concatenate([[True], values[1:] != values[:-1]]))
    return starts, np.diff(np.append(starts, len(values)))


def _sorted(keys: npt.NDArray[np.uint64]) -> tuple[Index, Index]:
    """(order of keys, the rank of each in this order: the same for equal ones)."""
    order = np.argsort(keys)
    keys = keys[order]
    return order, np.concatenate([[0], np.cumsum(keys[1:] != keys[:-1])])


@dataclass(frozen=True)
class Copies:
    """Shapes with the same faces and the same vertices welded, counted from each one's first vertex; or all that have no copy.

    ``faces``, ``vertices``: first face and vertex of each copy. ``rows``: faces of the first one, ascending.
    """

    faces: Index
    vertices: Index
    rows: Index

    @property
    def halves(self) -> Index:
        """Half-edges (3 * face + corner) of the first copy."""
        return (3 * self.rows[:, None] + np.arange(3)).ravel()

    def repeated(self, values: Index, step: int) -> Index:
        """Numbers that belong to the first copy (N,), for all of them (copies * N,): greater by ``step`` for each face."""
        return (values + step * (self.faces - self.faces[0])[:, None]).ravel()


def copies_of(faces: npt.NDArray[np.uint32], own: Index, shapes: npt.NDArray[np.integer[Any]] | None) -> list[Copies]:
    """All shapes that have faces (F, 3), in groups of copies. ``own`` and ``shapes`` (V,): as in :func:`weld`.

    Everything is one shape unless each has its vertices, and its faces, in one piece of its own.
    """
    found = None if shapes is None else _members(faces, own, shapes)
    if found is None:
        return [_alone(np.arange(len(faces)))]
    starts, sizes, first, members_of = found
    single = [members[0] for members in members_of if len(members) == 1]
    several = [members for members in members_of if len(members) > 1]
    copies = [Copies(starts[k], first[k], starts[k[0]] + np.arange(sizes[k[0]])) for k in several]
    if single:
        copies.append(_alone(np.concatenate([starts[k] + np.arange(sizes[k]) for k in single])))
    return copies


def _members(
    faces: npt.NDArray[np.uint32], own: Index, shapes: npt.NDArray[np.integer[Any]]
) -> tuple[Index, Index, Index, list[list[int]]] | None:
    """First face, number of faces, first vertex of each shape, and which shapes are copies of each other.

    None if vertices or faces of a shape are scattered. One shape after the other is looked at, which is fast as long as it fits
    into a cache.
    """
    if (shapes[1:] < shapes[:-1]).any():
        return None
    low, count = runs(shapes)
    # Where the faces of each shape begin if they stand in order. What does not is found below.
    starts = np.searchsorted(faces[:, 0], low)
    sizes = np.diff(np.append(starts, len(faces)))
    if starts[0] or (sizes < 0).any():
        return None
    kept = sizes > 0
    starts, sizes, low, count = starts[kept], sizes[kept], low[kept], count[kept]
    found: dict[tuple[bytes, bytes], list[int]] = {}
    for k, (start, size, first, vertices) in enumerate(zip(*(a.tolist() for a in (starts, sizes, low, count)), strict=True)):
        # Vertices before the first one are large numbers here.
        local = faces[start : start + size] - np.uint32(first)
        if local.max() >= vertices:
            return None
        key = local.tobytes(), (own[first : first + vertices] - first).tobytes()
        found.setdefault(key, []).append(k)
    return starts, sizes, low, list(found.values())


def _alone(rows: Index) -> Copies:
    zero = np.zeros(1, np.int64)
    return Copies(zero, zero, rows)

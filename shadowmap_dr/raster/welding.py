"""Vertices at the same place, and shapes that are moved copies of each other (on the host)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Index = npt.NDArray[np.int64]

# Odd numbers without a pattern, factors of a hash of coordinates.
_MIXERS = tuple(np.uint32(number) for number in (0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D))


@dataclass(frozen=True)
class Welded:
    """Representatives of V vertices.

    place  (V,) the first vertex at the same place
    own    (V,) the first vertex of the same shape at the same place
    """

    place: Index
    own: Index


@dataclass(frozen=True)
class Places:
    """Ranks of vertex positions in the order of x, then y, then z.

    rank   (V,) rank of each vertex from 0 on, equal for bitwise equal positions
    order  (V,) the vertices, ascending by rank
    """

    rank: Index
    order: Index

    @classmethod
    def of(cls, positions: npt.NDArray[np.float32]) -> Places:
        """Rank vertices (V, 3). Sorts integers, which is several times as fast as `numpy.lexsort`."""
        bits = np.ascontiguousarray(positions).view(np.uint32)
        # Integers in the order of the floats.
        x, y, z = np.where(bits >> np.uint32(31), ~bits, bits | np.uint32(1 << 31)).astype(np.uint64).T
        shift = np.uint64(32)
        order, before = _sorted(x << shift | y)
        again, rank = _sorted(before.astype(np.uint64) << shift | z[order])
        order = order[again]
        ranks = np.empty(len(order), np.int64)
        ranks[order] = rank
        return cls(ranks, order)


def weld(positions: npt.NDArray[np.float32], shapes: npt.NDArray[np.integer[Any]] | None) -> Welded:
    """Find vertices (V, 3) with bitwise equal positions. ``shapes`` (V,): the shape of each vertex, or None for one shape."""
    place = np.arange(len(positions))
    some = _perhaps_shared(positions)
    located = Places.of(positions[some])
    order = some[located.order]
    starts, sizes = runs(located.rank[located.order])
    shared = order[np.repeat(sizes > 1, sizes)]
    if not len(shared):
        return Welded(place, place)
    # Take the lowest of equal vertices: their order within a run is arbitrary.
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
    """Vertices that may coincide with another vertex, ascending: all that do, and few others.

    Compares hashes of positions. `numpy.sort` of hashes is many times as fast as `numpy.argsort`.
    """
    bits = np.ascontiguousarray(positions).view(np.uint32)
    # Multiplication moves bits upwards only, and coordinates on a grid have zeros as their last bits.
    mixed = (bits ^ bits >> np.uint32(16)) @ np.array(_MIXERS)
    mixed ^= mixed >> np.uint32(15)
    ascending = np.sort(mixed)
    several = ascending[1:][ascending[1:] == ascending[:-1]]
    if not len(several):
        return np.zeros(0, np.int64)
    # A table of the hashes' last bits excludes most vertices.
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
    """(order of keys, rank of each key in this order; equal keys have equal ranks)."""
    order = np.argsort(keys)
    keys = keys[order]
    return order, np.concatenate([[0], np.cumsum(keys[1:] != keys[:-1])])


@dataclass(frozen=True)
class Copies:
    """Shapes with the same faces and welding relative to their first vertices; or all shapes that have no copy.

    ``faces``, ``vertices``: first face and first vertex of each copy. ``rows``: faces of the first copy, ascending.
    """

    faces: Index
    vertices: Index
    rows: Index

    @property
    def halves(self) -> Index:
        """Half-edges (3 * face + corner) of the first copy."""
        return (3 * self.rows[:, None] + np.arange(3)).ravel()

    def repeated(self, values: Index, step: int) -> Index:
        """Indices (N,) in the first copy, for all copies (copies * N,): shifted by ``step`` times the shift of faces."""
        return (values + step * (self.faces - self.faces[0])[:, None]).ravel()


def copies_of(faces: npt.NDArray[np.uint32], own: Index, shapes: npt.NDArray[np.integer[Any]] | None) -> list[Copies]:
    """All shapes with faces (F, 3), in groups of copies. ``own`` and ``shapes`` (V,): as in :func:`weld`.

    The mesh counts as one shape unless the vertices and the faces of each shape are contiguous.
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

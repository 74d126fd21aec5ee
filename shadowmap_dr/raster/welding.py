"""Vertices at the same place, and shapes that are copies of each other but for where they are (on the host)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .types import NO_VERTEX

Index = npt.NDArray[np.int64]

# Odd numbers without a pattern, by which coordinates are mixed.
_MIXERS = tuple(np.uint64(number) for number in (0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9))


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


def weld(positions: npt.NDArray[np.float32], shapes: Index | None) -> Welded:
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
    key = place[shared] * (int(shapes.max()) + 1) + shapes[shared]
    order = np.argsort(key)
    starts, sizes = runs(key[order])
    own[shared[order]] = np.repeat(np.minimum.reduceat(shared[order], starts), sizes)
    return Welded(place, own)


def _perhaps_shared(positions: npt.NDArray[np.float32]) -> Index:
    """Vertices that may lie where another one does, ascending: all that do, and few others.

    Sums of their bits are compared. Sorting plain numbers is many times as fast as finding their order.
    """
    x, y, z = np.ascontiguousarray(positions).view(np.uint32).astype(np.uint64).T
    mixed = x * _MIXERS[0] + y * _MIXERS[1] + z * _MIXERS[2]
    mixed ^= mixed >> np.uint64(32)
    ascending = np.sort(mixed)
    several = ascending[1:][ascending[1:] == ascending[:-1]]
    if not len(several):
        return np.zeros(0, np.int64)
    # A table of the last bits sorts most of them out.
    last = np.uint64((1 << 20) - 1)
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

    def fill(self, target: npt.NDArray[np.uint32], shift: Index | None = None) -> None:
        """Copy numbers of the faces of the first copy to the places of the others in ``target``, (F,) or (3 F,).

        ``shift``: what to add for each copy; None: numbers are vertices, or ``NO_VERTEX``.
        """
        if len(self.faces) == 1:
            return
        each, count = (3, 3 * len(self.rows)) if shift is None else (1, len(self.rows))
        first = target[each * self.faces[0] :][:count]
        none = None if shift is not None else first == NO_VERTEX
        shift = self.vertices - self.vertices[0] if shift is None else shift
        for face, add in zip(self.faces[1:].tolist(), shift[1:].tolist(), strict=True):
            part = target[each * face : each * face + count]
            np.add(first, np.uint32(add), out=part)
            if none is not None:
                part[none] = NO_VERTEX


def copies_of(faces: npt.NDArray[np.uint32], own: Index, shapes: Index | None) -> list[Copies]:
    """All shapes that have faces (F, 3), in groups of copies. ``own`` and ``shapes`` (V,): as in :func:`weld`.

    Everything is one shape unless each has its vertices, and its faces, in one piece of its own.
    """
    whole = [_alone(np.arange(len(faces)))]
    if shapes is None or (np.diff(shapes) < 0).any():
        return whole
    owners = shapes.astype(np.int32)[faces]
    owner = owners[:, 0]
    if (np.diff(owner) < 0).any() or (owners != owner[:, None]).any():
        return whole
    starts, sizes = runs(owner)
    first = np.searchsorted(shapes, owner[starts])
    last = np.searchsorted(shapes, owner[starts], "right")
    local_faces = faces - np.repeat(first.astype(np.uint32), sizes)[:, None]
    local_own = own - np.repeat(*runs(shapes))
    found: dict[tuple[bytes, bytes], list[int]] = {}
    for k, (start, size, low, high) in enumerate(zip(starts, sizes, first, last, strict=True)):
        key = local_faces[start : start + size].tobytes(), local_own[low:high].tobytes()
        found.setdefault(key, []).append(k)
    single = [members[0] for members in found.values() if len(members) == 1]
    several = [members for members in found.values() if len(members) > 1]
    copies = [Copies(starts[k], first[k], starts[k[0]] + np.arange(sizes[k[0]])) for k in several]
    if single:
        copies.append(_alone(np.concatenate([starts[k] + np.arange(sizes[k]) for k in single])))
    return copies


def _alone(rows: Index) -> Copies:
    zero = np.zeros(1, np.int64)
    return Copies(zero, zero, rows)

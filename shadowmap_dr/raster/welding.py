"""Vertices at the same place, and shapes that are copies of each other but for where they are (on the host)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .types import NO_VERTEX

Index = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Welded:
    """Which vertices count as one, V of them.

    place  (V,) the first vertex at each one's place
    own    (V,) the first vertex of the same shape there
    """

    place: Index
    own: Index


def weld(positions: npt.NDArray[np.float32], shapes: Index | None) -> Welded:
    """Find the vertices (V, 3) at the same place, to the last bit. ``shapes`` (V,): whose they are, None if all are of one."""
    place, shared = _first_of_equal(positions)
    if shapes is None or not len(shared):
        return Welded(place, place)
    own = np.arange(len(place))
    key = place[shared] * (int(shapes.max()) + 1) + shapes[shared]
    order = np.argsort(key)
    starts, sizes = runs(key[order])
    own[shared[order]] = np.repeat(np.minimum.reduceat(shared[order], starts), sizes)
    return Welded(place, own)


def runs(values: npt.NDArray[np.generic]) -> tuple[Index, Index]:
    """(start, length) of each run of equal numbers."""
    starts = np.flatnonzero(np.concatenate([[True], values[1:] != values[:-1]]))
    return starts, np.diff(np.append(starts, len(values)))


def _first_of_equal(positions: npt.NDArray[np.float32]) -> tuple[Index, Index]:
    """(the first of the equal rows for each one, those that have an equal one)."""
    bits = np.ascontiguousarray(positions).view(np.uint32).astype(np.uint64)
    mixed = _mixed(bits)
    order = np.argsort(mixed)
    starts, sizes = runs(mixed[order])
    many = np.repeat(sizes > 1, sizes)
    shared = order[many]
    first = np.repeat(order[starts], sizes)[many]
    if (bits[shared] != bits[first]).any():
        order = np.lexsort(bits.T)
        rows = bits[order]
        starts = np.flatnonzero(np.concatenate([[True], (rows[1:] != rows[:-1]).any(1)]))
        sizes = np.diff(np.append(starts, len(rows)))
        many = np.repeat(sizes > 1, sizes)
        shared = order[many]
    place = np.arange(len(positions))
    if len(shared):
        place[shared] = np.repeat(np.minimum.reduceat(order, starts), sizes)[many]
    return place, shared


def _mixed(bits: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """Numbers that differ for different rows (N, 3), but by accident: they sort several times faster than rows."""
    mixed = (bits[:, 0] << np.uint64(32) | bits[:, 1]) * np.uint64(0x9E3779B97F4A7C15)
    return ((mixed ^ (mixed >> np.uint64(32))) + bits[:, 2]) * np.uint64(0xBF58476D1CE4E5B9)


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

    def copy_vertices(self, values: npt.NDArray[np.uint32], target: npt.NDArray[np.uint32]) -> None:
        """Write vertices of the first copy (N, 2) for all of them, one after the other, to ``target`` (copies * N, 2)."""
        shift = (self.vertices - self.vertices[0]).astype(np.uint32)
        np.add(values, shift[:, None, None], out=target.reshape(len(shift), *values.shape))

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

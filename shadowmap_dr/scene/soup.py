"""The vertices of many shapes at once, by kernels that do not depend on how many shapes there are.

What Mitsuba holds is read again for each image, as it may have been given other values. Shapes that carry no gradients are placed
in the world together, and only if any of them has changed; the others one by one, and their vertices are written over these.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError
from ..jit.arrays import device_array
from .mitsuba_objects import Parameter
from .shapes.sources import ShapeSource

# Stands for "no transformation" where a row of the table of transformations is meant.
_NONE = 0xFFFFFFFF
# Numbers of a row of that table: the first three rows of a matrix, and those of its inverse transpose.
_POINTS, _ROW = 12, 21


@dataclass(frozen=True)
class Vertices:
    """Vertices of all shapes, flat Float: positions, normals (3V), texture coordinates (2V), positions as Mitsuba holds them.

    Normals and texture coordinates are 0 for shapes without.
    """

    positions: Any
    normals: Any
    texcoords: Any
    rest: Any


class _Reading:
    """Arrays of one of Mitsuba's objects, read again and again.

    Attributes:
        arrays: as last read, detached. They are held, so that no others can be taken for them.
        changed: whether they have changed since they were last settled.
        attached: whether they carry gradients.
    """

    def __init__(self, read: Callable[[], Sequence[Any]]) -> None:
        self._read = read
        self._numbers: list[int] = []
        self.arrays: list[Any] = []
        self.changed, self.attached = True, False

    def look(self) -> None:
        """Read them."""
        arrays = list(self._read())
        self.attached = dr.grad_enabled(arrays)
        numbers = [array.index for array in arrays]
        if numbers != self._numbers:
            self._numbers, self.arrays, self.changed = numbers, [dr.detach(array) for array in arrays], True


class _Placement:
    """A ``to_world``, and its row in the table of transformations."""

    def __init__(self, node: Any, row: int) -> None:
        self._parameter, self.row = Parameter(node, "to_world"), row
        self.reading = _Reading(lambda: [entry for line in self._parameter.now().matrix for entry in line])

    def matrices(self) -> list[Any]:
        """Detached: that of points, and that of normals."""
        to_world = self._parameter.now()
        return [dr.detach(to_world.matrix), dr.detach(to_world.inverse_transpose)]

    @staticmethod
    def numbers(matrices: Sequence[Any]) -> list[float]:
        """The row of the table, for evaluated matrices. Read back entry by entry, since that takes no kernel."""
        points, normals = matrices
        first = [points[i, j][0] for i in range(3) for j in range(4)]
        return first + [normals[i, j][0] for i in range(3) for j in range(3)]


@dataclass(frozen=True)
class _Root:
    """Vertices before any transformation, from ``start`` on among those of all roots; of several shapes, it may be.

    ``name``, ``source``: of the first of these shapes, ``held``: whether they have (normals, texture coordinates).
    """

    name: str
    source: ShapeSource
    reading: _Reading
    start: int
    count: int
    held: tuple[bool, bool]

    def buffers(self) -> tuple[Any, Any, Any]:
        """Positions, normals and texture coordinates as they are now, detached; None in the place of what there was none of."""
        with dr.suspend_grad():
            rest = self.source.rest()
            now = len(rest.positions) // 3
            if now != self.count:
                raise ShadowmapError(f"Shape '{self.name}' now has {now} vertices instead of {self.count}: load the scene again.")
            chosen = (rest.normals if self.held[0] else None, rest.texcoords if self.held[1] else None)
            return tuple(None if array is None else dr.detach(array) for array in (rest.positions, *chosen))


class Soup:
    """The vertices of all shapes, as long as their numbers stay the same.

    Args:
        names: of the shapes, for messages.
        sources: of the shapes, in order.

    Attributes:
        held: whether each shape has (normals, texture coordinates).
        counts: numbers of their vertices.
    """

    def __init__(self, names: Sequence[str], sources: Sequence[ShapeSource]) -> None:
        self._roots: list[_Root] = []
        self._placements: list[_Placement] = []
        self.held: list[tuple[bool, bool]] = []
        roots, rows, counts = {}, {}, []
        root_of, own_rows, instance_rows = [], [], []
        for name, source in zip(names, sources, strict=True):
            # Those of one kind share their local mesh, instances what they show.
            key = id(source.shape if source.read() else source.rest().positions)
            if key not in roots:
                rest = source.rest()
                start = self._roots[-1].start + self._roots[-1].count if self._roots else 0
                held = rest.normals is not None, rest.texcoords is not None
                roots[key] = _Root(name, source, _Reading(source.read), start, len(rest.positions) // 3, held)
                self._roots.append(roots[key])
            root = roots[key]
            self.held.append(root.held)
            root_of.append(root)
            counts.append(root.count)
            for found, node in ((own_rows, source.own_placement), (instance_rows, source.instance)):
                if node is not None and node not in rows:
                    rows[node] = len(rows)
                    self._placements.append(_Placement(node, rows[node]))
                found.append(_NONE if node is None else rows[node])
        self.counts = np.array(counts, np.int64)
        self._starts = np.cumsum(self.counts) - self.counts
        self._readings = [[root.reading] for root in root_of]
        for rows_of in (own_rows, instance_rows):
            for readings, row in zip(self._readings, rows_of, strict=True):
                if row != _NONE:
                    readings.append(self._placements[row].reading)
        first = np.repeat(np.array([root.start for root in root_of]) - self._starts, self.counts)
        self._index = device_array(mi.UInt32, first + np.arange(len(first)))
        self._shape = device_array(mi.UInt32, np.repeat(np.arange(len(counts)), self.counts))
        self._rows = [device_array(mi.UInt32, r) if (np.array(r) != _NONE).any() else None for r in (own_rows, instance_rows)]
        none = len(self._placements)
        self._placement_rows = [np.array([none if row == _NONE else row for row in rows]) for rows in (own_rows, instance_rows)]
        total = sum(root.count for root in self._roots)
        self._host = [np.zeros((total, size), np.float32) for size in (3, 3, 2)]
        self._local: list[Any] = []
        self._table = np.zeros((len(self._placements), _ROW), np.float32)
        self._transformations: Any = None
        self._settled: Vertices | None = None
        self._over: tuple[tuple[int, ...], list[Any]] = ((), [])
        self._just_read = False

    def recording_text(self) -> str:
        """Nothing that recordings depend on is kept here: they get the vertices themselves."""
        return "soup"

    def vertices(self, single: Callable[[int], tuple[Any, Any, Any, Any]]) -> Vertices:
        """All vertices as they are now.

        ``single``: the vertices (:class:`Vertices`, as a tuple) of the shape of that number, attached.
        """
        if not self._just_read:
            self._look()
        self._just_read = False
        still = self._still()
        attached = tuple(k for k, readings in enumerate(self._readings) if any(r.attached for r in readings))
        if not attached:
            return still
        if attached != self._over[0]:
            ids = np.concatenate([self._starts[k] + np.arange(self.counts[k]) for k in attached])
            flat = [(size * ids[:, None] + np.arange(size)).ravel() for size in (3, 2)]
            self._over = attached, [device_array(mi.UInt32, index) for index in flat]
        threes, twos = self._over[1]
        parts = zip(*(single(k) for k in attached), strict=True)
        under = (still.positions, still.normals, still.texcoords, still.rest)
        targets = zip(under, parts, (threes, threes, twos, threes), strict=True)
        return Vertices(*(_written_over(buffer, list(pieces), index) for buffer, pieces, index in targets))

    def _look(self) -> None:
        for holder in (*self._roots, *self._placements):
            holder.reading.look()

    def _still(self, attached_too: bool = False) -> Vertices:
        """The vertices of all shapes, detached. Those of shapes that carry gradients are of no use unless ``attached_too``."""
        roots = [root for root in self._roots if root.reading.changed and (attached_too or not root.reading.attached)]
        moved = [p for p in self._placements if p.reading.changed and (attached_too or not p.reading.attached)]
        if self._settled is None or roots or moved:
            self._read_roots(roots)
            matrices = [placement.matrices() for placement in moved]
            dr.eval(matrices)
            for placement, pair in zip(moved, matrices, strict=True):
                self._table[placement.row] = placement.numbers(pair)
                placement.reading.changed = False
            if len(self._table):
                self._transformations = device_array(mi.Float, self._table)
            self._settled = self._placed()
        settled = self._settled
        return Vertices(*(mi.Float(buffer) for buffer in (settled.positions, settled.normals, settled.texcoords, settled.rest)))

    def _read_roots(self, roots: Sequence[_Root]) -> None:
        found = [root.buffers() for root in roots]
        dr.eval(found)
        for root, arrays in zip(roots, found, strict=True):
            root.reading.changed = False
            for host, array in zip(self._host, arrays, strict=True):
                part = host[root.start : root.start + root.count]
                part[:] = 0 if array is None else array.numpy().reshape(part.shape)
        if roots or not self._local:
            self._local = [device_array(mi.Float, host) for host in self._host]

    def own(self) -> tuple[Any, Any]:
        """Positions and normals as Mitsuba holds them: before the transformations of instances. Detached.

        The next call of :meth:`vertices` takes what was read for this one.
        """
        self._look()
        self._just_read = True
        with dr.suspend_grad():
            self._still(attached_too=True)
            local = [dr.gather(mi.Vector3f, buffer, self._index) for buffer in self._local[:2]]
            return tuple(dr.ravel(values) for values in self._moved(*local, self._rows[0]))

    def mirrored(self) -> tuple[np.ndarray, np.ndarray]:
        """True if shapes' own ``to_world``, or those of their instances, mirror them (bool (S,) each), as last read.

        False for shapes without.
        """
        negative = np.linalg.det(self._table[:, :_POINTS].reshape(-1, 3, 4)[:, :, :3].astype(np.float64)) < 0
        return tuple(np.append(negative, False)[rows] for rows in self._placement_rows)

    def _placed(self) -> Vertices:
        points, directions, texcoords = self._local
        p, n = dr.gather(mi.Vector3f, points, self._index), dr.gather(mi.Vector3f, directions, self._index)
        own = self._moved(p, n, self._rows[0])
        p, n = self._moved(*own, self._rows[1])
        # Texture coordinates are never transformed.
        uv = dr.gather(mi.Vector2f, texcoords, self._index)
        found = Vertices(*(dr.ravel(values) for values in (p, n, uv, own[0])))
        dr.eval([found.positions, found.normals, found.texcoords, found.rest])
        return found

    def _moved(self, p: Any, n: Any, rows: Any) -> tuple[Any, Any]:
        """Points and normals (Vector3f) by transformations, as ``sources`` does it for one shape.

        ``rows``: each shape's row (UInt32) of the table, or none; None if all have none.
        """
        if rows is None:
            return p, n
        row = dr.gather(mi.UInt32, rows, self._shape)
        placed = row != _NONE
        m = [dr.gather(mi.Float, self._transformations, row * _ROW + k, placed) for k in range(_ROW)]
        matrix, offset = mi.Matrix3f(*(m[4 * i + j] for i in range(3) for j in range(3))), mi.Vector3f(m[3], m[7], m[11])
        point, normal = mi.Vector3f(matrix @ p) + offset, mi.Vector3f(mi.Matrix3f(*m[_POINTS:]) @ n)
        # Shapes without normals have zeros.
        normal = dr.select(dr.squared_norm(normal) > 0, dr.normalize(normal), 0)
        return dr.select(placed, point, p), dr.select(placed, normal, n)


def _written_over(buffer: Any, pieces: Sequence[Any], index: npt.NDArray[np.uint32]) -> Any:
    """A copy of a buffer with the pieces, one after the other, in the places of ``index``. Attached to the pieces."""
    result = mi.Float(buffer)
    values = dr.concat(list(pieces)) if len(pieces) > 1 else pieces[0]
    dr.scatter(result, values, index, mode=dr.ReduceMode.NoConflicts)
    return result

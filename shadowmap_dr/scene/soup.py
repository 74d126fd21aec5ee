"""The vertices of many shapes at once, by kernels that do not depend on the number of shapes.

Mitsuba's arrays are read again for each image, since they may have new values. Shapes without gradients are placed in the world
together, and only if any of them has changed. Shapes with gradients are placed one by one; their vertices are then scattered over
those of the first step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError
from ..jit.arrays import device_array, ravel
from ..jit.types import Float, Matrix4f, UInt32, Vector3f
from ..jit.vectors import normalize_or
from .mitsuba_objects import Parameter
from .shapes.sources import ShapeSource

# Row of the table of transformations that means "no transformation".
_NONE = 0xFFFFFFFF
# Numbers in a row of that table: 3 x 4 of a matrix for points, and then 3 x 3 of its inverse transpose for normals.
_POINTS, _ROW = 12, 21


@dataclass(frozen=True)
class Vertices:
    """Vertices of all shapes, flat Float: positions, normals (3V), texture coordinates (2V), positions as Mitsuba holds them.

    Normals and texture coordinates are 0 for shapes that have none.
    """

    positions: Float
    normals: Float
    texcoords: Float
    rest: Float


class _Reading:
    """Arrays of one Mitsuba object, read for each image.

    Attributes:
        arrays: the arrays as last read, detached. Holding them keeps their variables' numbers from being used again.
        changed: whether they have changed since the soup last took them over.
        attached: whether they carry gradients.
    """

    def __init__(self, read: Callable[[], Sequence[Float]]) -> None:
        self._read = read
        self._numbers: list[int] = []
        self.arrays: list[Float] = []
        self.changed, self.attached = True, False

    def look(self) -> None:
        """Read the arrays."""
        arrays = list(self._read())
        self.attached = dr.grad_enabled(arrays)
        numbers = [array.index for array in arrays]
        if numbers != self._numbers:
            self._numbers, self.arrays, self.changed = numbers, [dr.detach(array) for array in arrays], True


class _Placement:
    """A ``to_world``, and its row in the table of transformations."""

    def __init__(self, node: mi.Shape, row: int) -> None:
        parameter = Parameter(node, "to_world")
        self._parameter, self.row = parameter, row
        # Not through self, which would then refer to itself and keep the shape until garbage is collected.
        self.reading = _Reading(lambda: [entry for line in parameter.now().matrix for entry in line])

    def matrices(self) -> list[Matrix4f]:
        """Matrix for points and matrix for normals, detached."""
        to_world = self._parameter.now()
        return [dr.detach(to_world.matrix), dr.detach(to_world.inverse_transpose)]

    @staticmethod
    def numbers(matrices: Sequence[Matrix4f]) -> list[float]:
        """The row of the table, for evaluated matrices. Read back entry by entry, since that takes no kernel."""
        points, normals = matrices
        first = [points[i][j][0] for i in range(3) for j in range(4)]
        return first + [normals[i][j][0] for i in range(3) for j in range(3)]


@dataclass(frozen=True)
class _Root:
    """Vertices before any transformation, which several shapes may share. They begin at ``start`` in the buffers of all roots.

    ``name``, ``source``: of the first of these shapes; ``held``: whether they have (normals, texture coordinates).
    """

    name: str
    source: ShapeSource
    reading: _Reading
    start: int
    count: int
    held: tuple[bool, bool]

    def buffers(self) -> tuple[Float, Float | None, Float | None]:
        """Current positions, normals and texture coordinates, detached; None if the shapes had none when the scene was loaded."""
        with dr.suspend_grad():
            rest = self.source.rest()
            now = len(rest.positions) // 3
            if now != self.count:
                raise ShadowmapError(f"Shape '{self.name}' now has {now} vertices instead of {self.count}: load the scene again.")
            normals, texcoords = (rest.normals if self.held[0] else None, rest.texcoords if self.held[1] else None)
            return (
                dr.detach(rest.positions),
                None if normals is None else dr.detach(normals),
                None if texcoords is None else dr.detach(texcoords),
            )


class Soup:
    """The vertices of all shapes. Vertex counts must stay the same.

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
        roots: dict[int, _Root] = {}
        rows: dict[mi.Shape, int] = {}
        counts: list[int] = []
        root_of: list[_Root] = []
        own_rows: list[int] = []
        instance_rows: list[int] = []
        for name, source in zip(names, sources, strict=True):
            # Analytic shapes of one kind share a local mesh; instances share the shapes of their group.
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
        self._local: list[Float] = []
        self._table = np.zeros((len(self._placements), _ROW), np.float32)
        self._transformations: Float | None = None
        self._settled: Vertices | None = None
        self._over: tuple[tuple[int, ...], list[UInt32]] = ((), [])
        self._just_read = False

    def recording_text(self) -> str:
        """Constant: recordings do not depend on the soup, since they get the vertices themselves."""
        return "soup"

    def vertices(self, single: Callable[[int], tuple[Float, Float, Float, Float]]) -> tuple[Vertices, list[int]]:
        """(all current vertices, attached; numbers of the shapes through whose vertices gradients flow).

        ``single``: returns the vertices (:class:`Vertices`, as a tuple) of the shape with the given number, attached.
        """
        if not self._just_read:
            self._look()
        self._just_read = False
        still = self._still()
        attached = tuple(k for k, readings in enumerate(self._readings) if any(r.attached for r in readings))
        if not attached:
            return still, []
        if attached != self._over[0]:
            ids = np.concatenate([self._starts[k] + np.arange(self.counts[k]) for k in attached])
            flat = [(size * ids[:, None] + np.arange(size)).ravel() for size in (3, 2)]
            self._over = attached, [device_array(mi.UInt32, index) for index in flat]
        threes, twos = self._over[1]
        parts = zip(*(single(k) for k in attached), strict=True)
        under = (still.positions, still.normals, still.texcoords, still.rest)
        targets = zip(under, parts, (threes, threes, twos, threes), strict=True)
        return Vertices(*(_written_over(buffer, list(pieces), index) for buffer, pieces, index in targets)), list(attached)

    def _look(self) -> None:
        for reading in (*(root.reading for root in self._roots), *(placement.reading for placement in self._placements)):
            reading.look()

    def _still(self, attached_too: bool = False) -> Vertices:
        """The vertices of all shapes, detached. Those of shapes with gradients are meaningless unless ``attached_too``."""
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

    def own(self) -> tuple[Float, Float]:
        """Positions and normals as Mitsuba holds them: before the transformations of instances. Detached.

        The next call of :meth:`vertices` reads nothing again.
        """
        self._look()
        self._just_read = True
        with dr.suspend_grad():
            self._still(attached_too=True)
            p, n = (dr.gather(mi.Vector3f, buffer, self._index) for buffer in self._local[:2])
            p, n = self._moved(p, n, self._rows[0])
            return ravel(p), ravel(n)

    def mirrored(self) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
        """True if a shape's own ``to_world``, or that of its instance, mirrored it when last read (bool (S,) each).

        False for shapes without.
        """
        negative = np.linalg.det(self._table[:, :_POINTS].reshape(-1, 3, 4)[:, :, :3].astype(np.float64)) < 0
        own, instances = (np.append(negative, False)[rows] for rows in self._placement_rows)
        return own, instances

    def _placed(self) -> Vertices:
        points, directions, texcoords = self._local
        p, n = dr.gather(mi.Vector3f, points, self._index), dr.gather(mi.Vector3f, directions, self._index)
        own = self._moved(p, n, self._rows[0])
        p, n = self._moved(*own, self._rows[1])
        # Texture coordinates are never transformed.
        uv = dr.gather(mi.Vector2f, texcoords, self._index)
        found = Vertices(ravel(p), ravel(n), ravel(uv), ravel(own[0]))
        dr.eval([found.positions, found.normals, found.texcoords, found.rest])
        return found

    def _moved(self, p: Vector3f, n: Vector3f, rows: UInt32 | None) -> tuple[Vector3f, Vector3f]:
        """Transformed points and normals (Vector3f), as ``sources`` transforms those of one shape.

        ``rows``: row of each shape in the table (UInt32), or ``_NONE``; None if no shape has a transformation.
        """
        if rows is None:
            return p, n
        row = dr.gather(mi.UInt32, rows, self._shape)
        placed = row != _NONE
        m = [dr.gather(mi.Float, self._transformations, row * _ROW + k, placed) for k in range(_ROW)]
        matrix, offset = mi.Matrix3f(*(m[4 * i + j] for i in range(3) for j in range(3))), mi.Vector3f(m[3], m[7], m[11])
        point, normal = mi.Vector3f(matrix @ p) + offset, mi.Vector3f(mi.Matrix3f(*m[_POINTS:]) @ n)
        # Shapes without normals have zeros.
        normal = normalize_or(normal, mi.Vector3f(0))
        return dr.select(placed, point, p), dr.select(placed, normal, n)


def _written_over(buffer: Float, pieces: Sequence[Float], index: UInt32) -> Float:
    """A copy of a buffer with the concatenated pieces scattered to ``index``. Attached to the pieces."""
    result = mi.Float(buffer)
    values = dr.concat(list(pieces)) if len(pieces) > 1 else pieces[0]
    dr.scatter(result, values, index, mode=dr.ReduceMode.NoConflicts)
    return result

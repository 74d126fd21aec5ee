"""One merged triangle soup of a scene, in world space, and its vertex normals.

The rasterizer draws the soup, from the camera and from the lights alike. Its static part (faces, texture coordinates, the shape
of each triangle) is separate from the two buffers that move (positions and normals): a step of an optimisation replaces only
these two and never touches Mitsuba's meshes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError
from ..jit.arrays import backend, device_array, ravel, reinterpret, replace_grad
from ..jit.broadcast import copy_of_lane, in_copies
from ..jit.handover import interleaved
from ..jit.pytree import StaticTuple
from ..jit.types import AnyArray, Bool, Float, Matrix4f, Point3f, UInt32, Vector3f, Vector3u
from ..jit.vectors import normalize_or
from .replaced_vertices import checked_matrix, checked_positions, moved, turned, with_vertices

NO_TRIANGLE = 0xFFFFFFFF
"""Triangle index that means "nothing was hit"."""

NOT_READ: Any = None  # Any: stands for buffers of several types, until ``load.refresh`` reads them

# Shape indices are compared with each index of a list up to this length. Longer lists cost more than they save.
_MANY_SHAPES = 8
# Look-ups for each triangle from which it pays to write the numbers of all triangles anew, side by side.
_LOOK_UPS = 4
# Numbers of vertices, the largest, to which recordings hold new positions.
_MOST_GUARDS = 64

HAS_NORMALS = 1
HAS_TEXCOORDS = 2
FLIP_GEOMETRIC = 4
FLIP_SHADING = 8
READS_ATTRIBUTES = 16
FACETED = 32
# Bits of ``Geometry.face_info`` that hold flags; the shape's index lies above them.
_FLAG_BITS = 8


@dataclass(frozen=True)
class ShapeInfo:
    """Facts about a shape without looking at its buffers. All fields are static.

    ``name`` is the Mitsuba id (``instance.child`` for an instanced shape). The shape owns vertices
    ``vertex_start .. vertex_start + vertex_count`` and faces ``face_start .. face_start + face_count`` of the soup.
    ``flip_geometric`` says that its geometric normal is *minus* (p1 - p0) x (p2 - p0), ``flip_shading`` that vertex normals
    are negated before use. ``reads_attributes``: it has mesh attributes, which Mitsuba finds through rest-pose positions.
    ``planar``: all its vertices lay in one plane when the scene was loaded. ``see_through``: its BSDF (``mask``,
    ``thindielectric``, ...) lets some light pass straight on. ``unseen``: its BSDF is ``null``, and it does not shine.
    ``faceted``: its vertex normals were those of its faces, as on a cube or rectangle, when the scene was loaded.
    ``against_winding``: its vertex normals, before ``flip_shading``, are on the other side of (p1 - p0) x (p2 - p0), and stay
    there when its vertices are replaced. ``varied``: what it reflects or emits may differ from place to place, as with a texture.
    """

    name: str
    plugin: str
    vertex_start: int
    vertex_count: int
    face_start: int
    face_count: int
    has_normals: bool
    has_texcoords: bool
    flip_geometric: bool = False
    flip_shading: bool = False
    reads_attributes: bool = False
    planar: bool = False
    see_through: bool = False
    faceted: bool = False
    against_winding: bool = False
    unseen: bool = False
    varied: bool = True

    @property
    def flags(self) -> int:
        """The booleans as bits, for ``Geometry.face_info``."""
        return (
            HAS_NORMALS * self.has_normals
            + HAS_TEXCOORDS * self.has_texcoords
            + FLIP_GEOMETRIC * self.flip_geometric
            + FLIP_SHADING * self.flip_shading
            + READS_ATTRIBUTES * self.reads_attributes
            + FACETED * self.faceted
        )


@dataclass(frozen=True)
class Geometry:
    """All triangles of a scene: V vertices, F faces, S shapes. A PyTree that may cross ``dr.freeze``.

    positions      Float  (3V,)  world space, may carry gradients
    normals        Float  (3V,)  unit vertex normals, world space, may carry gradients; zero for shapes without normals
    texcoords      Float  (2V,)  zero for shapes without texture coordinates
    rest_positions Float  (3V,)  positions as Mitsuba holds them, in the shape's own space, attached to Mitsuba's buffers (so that
                                 these cancel where barycentrics are recovered); None when no shape has mesh attributes
    faces          UInt32 (3F,)  indices into the vertices of the whole soup
    face_shape     UInt32 (F,)   index of the shape
    face_info      UInt32 (F,)   index and flags of the shape, see ``shape_and_flags``
    vertex_shape   UInt32 (V,)   index of the shape
    shape_face_start  UInt32 (S,)  ``ShapeInfo.face_start`` as an array
    changed        names of the shapes that are attached to a scene's parameters, have ``moved``, or were replaced by
                   ``with_positions``, if only their vertices may carry gradients; else None
    as_loaded      whether the other shapes are as they were when the scene was loaded
    moved          names of the planar and faceted shapes that may not be as they were then; None if that is not known
    stand_ins      UInt32 (V,), the vertex whose position each vertex takes; None if all vertices have faces. Invisible vertices,
                   those without faces, take the position of another vertex of their shape and so stretch no bounds (``settled``)
    packets        Float (4V,), positions padded to four numbers, through which derivatives flow back (``in_packets``)
    corners        Float (12F,), detached, for each triangle: vertex 0, vertices 1 and 2 minus vertex 0, and the bits of its three
                   indices; None where they are not worth it (``in_packets``)
    copies         number of copies of packets, normals and texture coordinates in their buffers, one for each block of lanes
    size_guards    UInt32 (Vs,) or (3Vs,) each, zeros: two arrays for each number of vertices that shapes have. Recordings add
                   them to new positions (``bound``)
    """

    RECORDED_OFTEN: ClassVar[bool] = True  # see `jit.frozen.take_apart`

    positions: Float
    normals: Float
    texcoords: Float
    rest_positions: Float | None
    faces: UInt32
    face_shape: UInt32
    face_info: UInt32
    vertex_shape: UInt32
    shape_face_start: UInt32
    shapes: StaticTuple[ShapeInfo]
    changed: tuple[str, ...] | None = None
    as_loaded: bool = False
    moved: tuple[str, ...] | None = None
    stand_ins: UInt32 | None = None
    packets: Float | None = None
    corners: Float | None = None
    copies: int = 1
    size_guards: tuple[UInt32, ...] = ()

    @property
    def vertex_count(self) -> int:
        """Number of vertices of all shapes."""
        last = self.shapes[-1]
        return last.vertex_start + last.vertex_count

    @property
    def face_count(self) -> int:
        """Number of triangles of all shapes."""
        last = self.shapes[-1]
        return last.face_start + last.face_count

    def shape(self, name: str) -> ShapeInfo:
        """The shape called ``name``; raises ``ShadowmapError`` listing the known names otherwise."""
        for info in self.shapes:
            if info.name == name:
                return info
        known = ", ".join(repr(info.name) for info in self.shapes)
        raise ShadowmapError(f"There is no shape '{name}' in the scene; its shapes are {known}.")

    def shape_positions(self, name: str) -> Point3f:
        """Positions of one shape as Point3f (Vs,), world space, attached."""
        info = self.shape(name)
        return dr.gather(mi.Point3f, self.positions, dr.arange(mi.UInt32, info.vertex_count) + info.vertex_start)

    def shape_and_flags(self, triangle: UInt32, active: Bool | bool) -> tuple[UInt32, UInt32]:
        """(index of the shape, its ``ShapeInfo.flags``), UInt32 each, for each triangle."""
        info = dr.gather(mi.UInt32, self.face_info, triangle, active)
        return info >> _FLAG_BITS, info & (2**_FLAG_BITS - 1)

    def has_changed(self, shape: UInt32) -> Bool:
        """True where a shape (UInt32, index) may have been replaced. Vertices of other shapes carry no gradients."""
        if self.changed is None:
            return mi.Bool(True)
        chosen = [info.name in self.changed for info in self.shapes]
        wanted = sum(chosen) <= len(chosen) // 2
        listed = [k for k, value in enumerate(chosen) if value == wanted]
        if len(listed) > _MANY_SHAPES:
            return mi.Bool(True)
        found = mi.Bool(False)
        for k in listed:
            found |= shape == k
        return found if wanted else ~found

    def names_of(self, numbers: Sequence[int]) -> tuple[str, ...]:
        """Names of shapes."""
        return tuple(self.shapes[k].name for k in numbers)

    def attached(self, info: ShapeInfo) -> bool:
        """True if vertices of a shape may carry gradients (known on the host)."""
        if dr.grad_enabled(self.texcoords):
            return True
        return dr.grad_enabled(self.positions, self.normals) and (self.changed is None or info.name in self.changed)

    def attached_places(self) -> bool:
        """True if the triangles or texture coordinates of shapes with textures may carry gradients (known on the host)."""
        return dr.grad_enabled(self.positions, self.normals, self.texcoords) and any(
            info.varied and self.attached(info) for info in self.shapes
        )

    def known_unchanged(self, info: ShapeInfo) -> bool:
        """True if a planar or faceted shape is known (on the host) to be as it was when the scene was loaded."""
        return self.moved is not None and info.name not in self.moved and info.name not in (self.changed or ())

    def in_packets(self, lanes: int) -> Geometry:
        """The same geometry, prepared for look-ups of attached positions, normals and texture coordinates by ``lanes`` lanes.

        Sums over packets of four numbers run several times faster than those of three. Where many lanes look up few triangles,
        three packets for each triangle (``corners``) take less time than its indices and vertices one by one.
        """
        packets, corners = self.packets, None
        if _LOOK_UPS * self.face_count <= lanes:
            corners = interleaved("corners of triangles", self._corners())
        if dr.grad_enabled(self.positions):
            p = dr.gather(mi.Point3f, self.positions, dr.arange(mi.UInt32, self.vertex_count))
            packets = ravel(mi.Point4f(p.x, p.y, p.z, 0))
        buffers = [array for array in (packets, self.normals, self.texcoords) if array is not None]
        made, copies = in_copies(buffers, lanes)
        if copies == 1:
            return replace(self, packets=packets, corners=corners)
        *first, normals, texcoords = made
        packets = first[0] if first else None
        return replace(self, packets=packets, corners=corners, normals=normals, texcoords=texcoords, copies=copies)

    def _corners(self) -> list[Float]:
        """Numbers of ``corners``."""
        with dr.suspend_grad():
            face = dr.gather(mi.Vector3u, self.faces, dr.arange(mi.UInt32, self.face_count))
            first, e1, e2 = self.triangle(face)
            return [mi.Float(x) for x in (*first, *e1, *e2, *(reinterpret(mi.Float, index) for index in face))]

    def triangle(self, face: Vector3u, active: Bool | bool = True, row: UInt32 | int = 0) -> tuple[Point3f, Vector3f, Vector3f]:
        """Vertex 0 of triangles (``face``: their vertices), and vertices 1 and 2 minus vertex 0. ``row``: as :meth:`vertices`."""
        first, second, third = (self.vertices(face[k], active, row=row) for k in range(3))
        return first, second - first, third - first

    def triangle_now(self, index: UInt32, active: Bool) -> tuple[Vector3u, tuple[Point3f, Vector3f, Vector3f]]:
        """The vertices of triangles (UInt32), and what :meth:`triangle` returns for them; detached."""
        with dr.suspend_grad():
            if self.corners is None:
                face = dr.gather(mi.Vector3u, self.faces, index, active)
                return face, self.triangle(face, active)
            n = [number for k in range(3) for number in dr.gather(mi.Vector4f, self.corners, 3 * index + k, active)]
            face = mi.Vector3u(*(reinterpret(mi.UInt32, bits) for bits in n[9:]))
            return face, (mi.Point3f(*n[:3]), mi.Point3f(*n[3:6]), mi.Point3f(*n[6:9]))

    def row_of_copy(self, lanes: int) -> UInt32:
        """First row (UInt32) of the copy of the vertices that each lane reads; a constant if there is only one copy."""
        return copy_of_lane(backend(self.faces), lanes, self.copies) * self.vertex_count

    def vertices(
        self, index: UInt32, active: Bool | bool = True, changed: Bool | bool | None = None, row: UInt32 | int = 0
    ) -> Point3f:
        """Positions (Point3f) of vertices (UInt32); gradients flow only where they may have ``changed`` (None: anywhere).

        ``row``: :meth:`row_of_copy` of the lanes, if the copies were made for these lanes.
        """
        p = dr.gather(mi.Point3f, self.positions, index, active)
        if not dr.grad_enabled(self.positions):
            return p
        changed = active if changed is None else changed
        if self.packets is None:
            return replace_grad(p, dr.gather(mi.Point3f, self.positions, index, changed))
        q = dr.gather(mi.Point4f, self.packets, index + row, changed)
        return replace_grad(p, mi.Point3f(q.x, q.y, q.z))

    def with_positions(self, positions: Mapping[str, AnyArray | npt.ArrayLike]) -> Geometry:
        """A new Geometry with other positions for some shapes.

        Each value holds the world-space positions of all Vs vertices of the shape: Float (3Vs,) interleaved as xyzxyz...,
        TensorXf or NumPy array (Vs, 3), or Point3f/Vector3f (Vs,). Gradients flow through. Normals of shapes that have them
        are computed anew with Mitsuba's angle weighting (``vertex_normals``), attached.

        Raises:
            ShadowmapError: a name or a size that is not the scene's.
        """
        if not isinstance(positions, Mapping):
            raise ShadowmapError(f"vertex_positions is a {type(positions).__name__}: give a dictionary of the shapes' names.")
        if not positions:
            return self
        merged = self.positions
        for name, value in positions.items():
            info = self.shape(name)
            checked = self.bound(checked_positions(name, value, info.vertex_count))
            merged = with_vertices(merged, checked, info.vertex_start, info.vertex_count, self.vertex_count)
        normals = self.normals
        for name in positions:
            info = self.shape(name)
            if info.has_normals:
                smooth = vertex_normals(merged, _faces_of(self.faces, info), self.vertex_count)
                own = dr.arange(mi.UInt32, info.vertex_count) + info.vertex_start
                outward = dr.gather(mi.Normal3f, smooth, own) * (-1 if info.against_winding else 1)
                normals = with_vertices(normals, outward, info.vertex_start, info.vertex_count, self.vertex_count)
        return self._replaced(merged, normals, positions)

    def with_transforms(self, transforms: Mapping[str, Matrix4f | mi.Transform4f]) -> Geometry:
        """A new Geometry in which some shapes have moved as a whole.

        Args:
            transforms: by the name of the shape, an affine map of world space (Matrix4f of width 1, or Transform4f), applied to
                the current vertices. Vertex normals move along instead of being computed anew. Attached.

        Raises:
            ShadowmapError: a name that is not the scene's; a value that is no transformation.
        """
        if not isinstance(transforms, Mapping):
            raise ShadowmapError(f"transforms is a {type(transforms).__name__}: give a dictionary of the shapes' names.")
        if not transforms:
            return self
        positions, normals = self.positions, self.normals
        for name, value in transforms.items():
            info, matrix = self.shape(name), checked_matrix(name, value)
            where = info.vertex_start, info.vertex_count, self.vertex_count
            own = dr.arange(mi.UInt32, info.vertex_count) + info.vertex_start
            # Twelve numbers that all vertices share: evaluated once.
            dr.eval(matrix)
            positions = with_vertices(positions, moved(matrix, dr.gather(mi.Point3f, positions, own)), *where)
            if info.has_normals:
                normals = with_vertices(normals, mi.Point3f(turned(matrix, dr.gather(mi.Vector3f, normals, own))), *where)
        return self._replaced(positions, normals, transforms)

    def _replaced(self, positions: Float, normals: Float, names: Iterable[str]) -> Geometry:
        """The same geometry with other buffers, in which the vertices of some shapes are new."""
        changed = self.changed
        if changed is None and not dr.grad_enabled(self.positions, self.normals):
            changed = self.moved or ()
        if changed is not None:
            changed = tuple(sorted({*changed, *names}))
        return replace(self, positions=self.settled(positions), normals=normals, changed=changed, packets=None, corners=None)

    def bound(self, value: Float | Point3f) -> Float | Point3f:
        """New positions of a shape, in a recording held to their number: a replay with another number is an error of Dr.Jit's.

        Sizes are checked while a function is recorded, not while it is replayed. A replay with more vertices would write behind
        the end of an array.
        """
        if not dr.flag(dr.JitFlag.FreezingScope):
            return value
        guard = next((zeros for zeros in self.size_guards if dr.width(zeros) == dr.width(value)), None)
        return value if guard is None else value + mi.Float(guard)

    def settled(self, positions: Float) -> Float:
        """Positions (Float, 3V) in which each vertex without faces has moved to its stand-in."""
        return positions if self.stand_ins is None else ravel(dr.gather(mi.Point3f, positions, self.stand_ins))


def vertex_normals(positions: Float, faces: Vector3u, vertex_count: int) -> Float:
    """Smooth unit vertex normals: face normals weighted by the angle at the vertex, as Mitsuba does.

    positions Float (3V,), any space; faces Vector3u (F,). Returns Float (3V,). Where the face normals of a vertex cancel, or it
    has no faces, the result is (1, 0, 0), as Mitsuba's. Gradients flow to positions.
    Source: Thuermer and Wuethrich, "Computing Vertex Normals from Polygonal Facets", 1998.
    """
    p0, p1, p2 = (dr.gather(mi.Point3f, positions, faces[i]) for i in range(3))
    e01, e02, e12 = p1 - p0, p2 - p0, p2 - p1
    n = dr.cross(e01, e02)
    n_squared = dr.squared_norm(n)
    valid = n_squared > 0
    # |e_i x e_j| is the same (twice the area) at all three corners, so the angles need one square root only.
    area2 = dr.sqrt(dr.select(valid, n_squared, 1.0))
    n = dr.select(valid, n / area2, 0.0)
    angles = (dr.atan2(area2, dr.dot(e01, e02)), dr.atan2(area2, -dr.dot(e01, e12)), dr.atan2(area2, dr.dot(e02, e12)))
    sums = dr.zeros(mi.Float, 3 * vertex_count)
    for corner, angle in enumerate(angles):
        dr.scatter_add(sums, n * angle, faces[corner], active=valid)
    total = dr.unravel(mi.Vector3f, sums)
    # The weights are angles: a sum of this size is the rounding error of faces that lie back to back.
    total = dr.select(dr.squared_norm(total) > 1e-10, total, 0.0)
    return ravel(normalize_or(total, mi.Vector3f(1.0, 0.0, 0.0)))


def rows_of(starts: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """The numbers ``start`` to ``start + count - 1`` of each pair (int64), one after the other."""
    return np.repeat(starts - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())


def with_faces(faces: np.ndarray, count: int) -> np.ndarray:
    """Mask (bool) of the vertices, out of ``count``, that belong to a face (F, 3)."""
    found = np.zeros(count, np.bool_)
    found[faces] = True
    return found


def stand_ins(
    faces: np.ndarray, vertex_shape: np.ndarray, shapes: tuple[ShapeInfo, ...], meshes: np.ndarray
) -> np.ndarray | None:
    """``Geometry.stand_ins``, uint32 (V,), for faces (F, 3) and each vertex's shape (V,).

    ``meshes`` (S,): True for shapes that are meshes in Mitsuba. Shapes that are tessellated here need no stand-ins: all their
    vertices lie on their surfaces.
    """
    chosen = [info for info, mesh in zip(shapes, meshes.tolist(), strict=True) if mesh]
    own = [
        rows_of(*np.array(pairs, np.int64).reshape(-1, 2).T)
        for pairs in (
            [(info.face_start, info.face_count) for info in chosen],
            [(info.vertex_start, info.vertex_count) for info in chosen],
        )
    ]
    used = np.ones(len(vertex_shape), np.bool_)
    used[own[1]] = False
    used[faces[own[0]]] = True
    if used.all():
        return None
    visible = faces[[info.face_start for info in shapes], 0]
    return np.where(used, np.arange(len(used)), visible[vertex_shape]).astype(np.uint32)


def size_guards_of(shapes: tuple[ShapeInfo, ...]) -> tuple[UInt32, ...]:
    """``Geometry.size_guards``; of many numbers of vertices only the largest."""
    counts = sorted({info.vertex_count for info in shapes})[-_MOST_GUARDS:]
    widths = sorted({width for count in counts for width in (count, 3 * count)})
    return tuple(device_array(mi.UInt32, np.zeros(width, np.uint32)) for width in widths)


def pack_face_info(shapes: tuple[ShapeInfo, ...]) -> np.ndarray:
    """``Geometry.face_info``, uint32 (F,), for shapes in the order of the soup."""
    packed = [(index << _FLAG_BITS) + info.flags for index, info in enumerate(shapes)]
    return np.repeat(np.array(packed, np.uint32), [info.face_count for info in shapes])


def _faces_of(faces: UInt32, info: ShapeInfo) -> Vector3u:
    return dr.gather(mi.Vector3u, faces, dr.arange(mi.UInt32, info.face_count) + info.face_start)

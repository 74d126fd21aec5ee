"""Sources of the vertices of the triangle soup: one class for each kind of shape.

A source knows what stays the same for as long as the scene's topology does, and reads anew what parameters may change: vertices
of a mesh, ``to_world`` of an analytic shape, control points of a curve. Gradients flow to all of these.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...errors import ShadowmapError, UnsupportedShape
from ...jit.arrays import device_array
from ..mitsuba_objects import Parameter, mesh_buffers, parameters
from . import curves, tubes
from . import tessellation as shapes_tessellation

_ANALYTIC = {"Sphere": shapes_tessellation.sphere, "Disk": shapes_tessellation.disk, "Cylinder": shapes_tessellation.cylinder}
_CURVES = {"BSplineCurve": curves.BSplines, "LinearCurve": curves.Polylines}


@dataclass(frozen=True)
class Buffers:
    """Vertices of a shape, flat Float, attached: positions (3V,), normals (3V,) or None, texture coordinates (2V,) or None."""

    positions: Any
    normals: Any
    texcoords: Any


@dataclass(frozen=True)
class ShapeSource:
    """Source of the vertices of one shape of the soup.

    ``shape`` is the ``mi.Shape``, ``instance`` the ``mi.Shape`` that places it in the world or None.
    """

    shape: Any
    instance: Any

    def own(self) -> Buffers:
        """Vertices where Mitsuba holds them: before the instance's transformation."""
        return self.rest()

    def rest(self) -> Buffers:
        """Vertices before any transformation."""
        raise NotImplementedError

    def read(self) -> tuple[Any, ...]:
        """Arrays of Mitsuba's that :meth:`rest` depends on."""
        return ()

    @property
    def own_placement(self) -> Any:
        """The ``mi.Shape`` whose ``to_world`` leads from :meth:`rest` to :meth:`own`, or None."""
        return None

    def statics(self) -> tuple[Any, ...]:
        """Arrays that decided on the topology. Where they change, the scene has to be loaded again."""
        return ()

    def sizes(self) -> tuple[int, ...]:
        """Lengths of arrays and flags that decided on the topology and on what is read, likewise."""
        return ()

    def transformed(self) -> tuple[Any, ...]:
        """Objects of Mitsuba's whose ``to_world`` places the shape. Where one comes to mirror it, or no longer does, the scene
        has to be loaded again."""
        return () if self.instance is None else (self.instance,)

    def placed(self, own: Buffers) -> Buffers:
        """The same vertices in world space: after the instance's transformation."""
        return own if self.instance is None else _placed(own, Parameter(self.instance, "to_world").now())


@dataclass(frozen=True)
class MeshSource(ShapeSource):
    """The buffers of a ``mi.Mesh``."""

    def rest(self) -> Buffers:
        _, positions, normals, texcoords = mesh_buffers(self.shape)
        return Buffers(positions, normals if len(normals) else None, texcoords if len(texcoords) else None)

    def read(self) -> tuple[Any, ...]:
        return mesh_buffers(self.shape)[1:]

    def statics(self) -> tuple[Any, ...]:
        return (mesh_buffers(self.shape)[0],)

    def sizes(self) -> tuple[int, ...]:
        mesh = self.shape
        return mesh.vertex_count(), mesh.face_count(), mesh.has_vertex_normals(), mesh.has_vertex_texcoords()


@dataclass(frozen=True)
class PlacedSource(ShapeSource):
    """A shape whose only parameter is ``to_world``: ``local`` is a mesh that does not change.

    A rectangle is one, although a ``mi.Mesh``. The vertices that Mitsuba holds of it hang on ``to_world`` by a part of the AD
    graph that is made when it is updated, and gone once derivatives have passed through: a second image would be left without.
    """

    local: Buffers

    def own(self) -> Buffers:
        return _placed(self.local, Parameter(self.shape, "to_world").now())

    def rest(self) -> Buffers:
        return self.local

    @property
    def own_placement(self) -> Any:
        return self.shape

    def transformed(self) -> tuple[Any, ...]:
        return (self.shape, *super().transformed())


@dataclass(frozen=True)
class AnalyticSource(PlacedSource):
    """A sphere, disk or cylinder. Mitsuba has all other parameters in ``to_world`` (``center``, ``radius``, ``p0``, ``p1``)."""

    def sizes(self) -> tuple[int, ...]:
        # Mitsuba turns a sphere's normals over where ``to_world`` comes to mirror it.
        return (self.shape.has_flipped_normals(),)


@dataclass(frozen=True)
class CurveSource(ShapeSource):
    """B-spline or linear curves: circles about points of the curves that the shape's control points place.

    ``name`` for messages, ``plan`` and ``layout``: which circles there are and how they are joined, ``count``: of control points.
    """

    name: str
    plan: curves.BSplines | curves.Polylines
    layout: tubes.Layout
    count: int

    def rest(self) -> Buffers:
        (points,) = self.read()
        now = len(points) / 4
        if now != self.count:
            changed = f"now has {now:g} control points instead of {self.count}"
            raise ShadowmapError(f"Curve '{self.name}' {changed}: load the scene again.")
        return self.with_control_points(points)

    def read(self) -> tuple[Any, ...]:
        return (mi.Float(parameters(self.shape)["control_points"]),)

    def with_control_points(self, points: Any) -> Buffers:
        """Vertices for control points (x, y, z, radius), flat Float (4P,), attached to them; before the instance's placement."""
        return Buffers(*tubes.tube_mesh(self.layout, self.plan.circles(points)))

    def statics(self) -> tuple[Any, ...]:
        return (mi.UInt32(parameters(self.shape)["segment_indices"]),)

    def sizes(self) -> tuple[int, ...]:
        return (len(parameters(self.shape)["control_points"]),)


Found = tuple[ShapeSource, np.ndarray]


def source_of(name: str, shape: Any, instance: Any, tessellation: int, known: dict[Any, Any] | None = None) -> Found:
    """The source of a shape's vertices and its faces, uint32 (F, 3).

    ``tessellation``: triangles around spheres, disks and cylinders. Curves have half as many around them and, if they are
    B-splines, an eighth of it along each segment. ``known``: what other shapes of the scene share, kept here from one call to the
    next. Raises ``ShadowmapError`` for other shapes and for curves that are broken.
    """
    known = {} if known is None else known
    if shape not in known:
        known[shape] = _new_source(name, shape, tessellation, known)
    source, faces = known[shape]
    return replace(source, instance=instance), faces


def _new_source(name: str, shape: Any, tessellation: int, known: dict[Any, Any]) -> Found:
    kind, instance = shape.class_name(), None
    if kind == "Rectangle":
        faces, _, _, texcoords = (buffer.numpy() for buffer in mesh_buffers(shape))
        # In its own space a rectangle's corners are those of its texture's, from -1 to 1.
        uv = texcoords.reshape(-1, 2)
        if uv.tobytes() not in known:
            mesh = (np.insert(2 * uv - 1, 2, 0, 1), np.tile(np.float32([0, 0, 1]), (len(uv), 1)), uv)
            known[uv.tobytes()] = Buffers(*(device_array(mi.Float, a) for a in mesh))
        return PlacedSource(shape, instance, known[uv.tobytes()]), faces.reshape(-1, 3)
    if isinstance(shape, mi.Mesh):
        return MeshSource(shape, instance), mesh_buffers(shape)[0].numpy().reshape(-1, 3)
    if kind in _ANALYTIC:
        if kind not in known:
            mesh = _ANALYTIC[kind](tessellation)
            local = Buffers(*(device_array(mi.Float, a) for a in (mesh.positions, mesh.normals, mesh.texcoords)))
            known[kind] = local, mesh.faces
        local, faces = known[kind]
        return AnalyticSource(shape, instance, local), faces
    if kind in _CURVES:
        held = parameters(shape)
        points, segments = np.array(held["control_points"]), np.array(held["segment_indices"])
        points = points[: len(points) // 4 * 4].reshape(-1, 4)
        curves.check_control_points(name, points, segments, _CURVES[kind].points_of_segment)
        plan, layout = _CURVES[kind].plan(segments, max(tessellation // 2, 3), max(tessellation // 8, 1))
        return CurveSource(shape, instance, name, plan, layout, len(points)), layout.faces()
    raise UnsupportedShape(
        f"shape '{name}' ({kind}) is not supported: use meshes, spheres, disks, cylinders, bsplinecurve, linearcurve, instances."
    )


def _placed(buffers: Buffers, to_world: Any) -> Buffers:
    """Points by a transformation, normals by its inverse transpose (then made unit)."""
    matrix = to_world.matrix
    offset = mi.Vector3f(matrix[0, 3], matrix[1, 3], matrix[2, 3])
    positions = mi.Vector3f(mi.Matrix3f(matrix) @ _vectors(buffers.positions)) + offset
    normals = buffers.normals
    if normals is not None:
        normals = dr.ravel(dr.normalize(mi.Vector3f(mi.Matrix3f(to_world.inverse_transpose) @ _vectors(normals))))
    return Buffers(dr.ravel(positions), normals, buffers.texcoords)


def _vectors(flat: Any) -> Any:
    # Not ``dr.unravel``, whose adjoint overwrites what other instances of the same buffer have added.
    return dr.gather(mi.Vector3f, flat, dr.arange(mi.UInt32, dr.width(flat) // 3))

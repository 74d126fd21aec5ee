"""Sources of the vertices of the triangle soup: one class for each kind of shape.

A source keeps the data that the topology determines and reads the parameters anew each time: vertices of a mesh, ``to_world`` of
an analytic shape, control points of a curve. Gradients flow to all of these.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...errors import ShadowmapError, UnsupportedShape, warn
from ...jit.arrays import device_array, ravel
from ...jit.types import Float, UInt32, Vector3f
from ..mitsuba_meshes import mesh_buffers
from ..mitsuba_objects import Parameter, parameters
from . import curves, tubes
from . import tessellation as shapes_tessellation

_ANALYTIC = {"Sphere": shapes_tessellation.sphere, "Disk": shapes_tessellation.disk, "Cylinder": shapes_tessellation.cylinder}
_CURVES: dict[str, type[curves.BSplines] | type[curves.Polylines]] = {
    "BSplineCurve": curves.BSplines,
    "LinearCurve": curves.Polylines,
}


@dataclass(frozen=True)
class Buffers:
    """Vertices of a shape, flat Float, attached: positions (3V,), normals (3V,) or None, texture coordinates (2V,) or None."""

    positions: Float
    normals: Float | None
    texcoords: Float | None


@dataclass(frozen=True)
class ShapeSource:
    """Source of the vertices of one shape of the soup.

    ``shape`` is the ``mi.Shape``, ``instance`` the ``mi.Shape`` that places it in the world or None.
    """

    shape: mi.Shape
    instance: mi.Shape | None

    def own(self) -> Buffers:
        """Vertices as Mitsuba holds them: before the instance's transformation."""
        return self.rest()

    def rest(self) -> Buffers:
        """Vertices before any transformation."""
        raise NotImplementedError

    def read(self) -> tuple[Float, ...]:
        """Arrays of Mitsuba's that :meth:`rest` depends on."""
        return ()

    @property
    def own_placement(self) -> mi.Shape | None:
        """The ``mi.Shape`` whose ``to_world`` leads from :meth:`rest` to :meth:`own`, or None."""
        return None

    def statics(self) -> tuple[UInt32, ...]:
        """Arrays that determine the topology. If one changes, the scene has to be loaded again."""
        return ()

    def sizes(self) -> tuple[int, ...]:
        """Lengths of arrays, and flags, that determine the topology. If one changes, the scene has to be loaded again."""
        return ()

    def transformed(self) -> tuple[mi.Shape, ...]:
        """Objects of Mitsuba's whose ``to_world`` places the shape. If one starts or stops mirroring, the scene has to be loaded
        again."""
        return () if self.instance is None else (self.instance,)

    def placed(self, own: Buffers) -> Buffers:
        """The same vertices in world space: after the instance's transformation."""
        return own if self.instance is None else _placed(own, Parameter(self.instance, "to_world").now())


@functools.cache
def _warn_of_normals(name: str) -> None:
    """Warn once for each shape: `params.update()` makes the normals anew, attached to the vertices."""
    warn(
        f"Derivatives by the vertices of shape '{name}' leave out its vertex normals, as with Mitsuba's integrators: "
        "call params.update() after dr.enable_grad."
    )


@dataclass(frozen=True)
class MeshSource(ShapeSource):
    """The buffers of a ``mi.Mesh``."""

    def rest(self) -> Buffers:
        _, positions, normals, texcoords = mesh_buffers(self.shape)
        if len(normals) and dr.grad_enabled(positions) and not dr.grad_enabled(normals):
            _warn_of_normals(self.shape.id())
        return Buffers(positions, normals if len(normals) else None, texcoords if len(texcoords) else None)

    def read(self) -> tuple[Float, ...]:
        return mesh_buffers(self.shape)[1:]

    def statics(self) -> tuple[UInt32, ...]:
        return (mesh_buffers(self.shape)[0],)

    def sizes(self) -> tuple[int, ...]:
        mesh = self.shape
        return mesh.vertex_count(), mesh.face_count(), mesh.has_vertex_normals(), mesh.has_vertex_texcoords()


@dataclass(frozen=True)
class PlacedSource(ShapeSource):
    """A shape whose only parameter is ``to_world``: ``local`` is a mesh that does not change.

    A rectangle is such a shape, although it is a ``mi.Mesh``: Mitsuba attaches its vertices to ``to_world`` only when the scene
    is updated, and a backward pass removes that part of the AD graph, so that a second image would have no derivatives.
    """

    local: Buffers

    def own(self) -> Buffers:
        return _placed(self.local, Parameter(self.shape, "to_world").now())

    def rest(self) -> Buffers:
        return self.local

    @property
    def own_placement(self) -> mi.Shape:
        return self.shape

    def transformed(self) -> tuple[mi.Shape, ...]:
        return (self.shape, *super().transformed())


@dataclass(frozen=True)
class AnalyticSource(PlacedSource):
    """A sphere, disk or cylinder. Mitsuba's ``to_world`` holds the other parameters (``center``, ``radius``, ``p0``, ``p1``)."""

    def sizes(self) -> tuple[int, ...]:
        # Mitsuba flips a sphere's normals when ``to_world`` starts to mirror it.
        return (self.shape.has_flipped_normals(),)


@dataclass(frozen=True)
class CurveSource(ShapeSource):
    """B-spline or linear curves: circles about points of the curves, placed by the shape's control points.

    ``name``: for messages; ``plan``: the circles; ``layout``: their joints and corners; ``count``: number of control points.
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

    def read(self) -> tuple[Float, ...]:
        return (mi.Float(parameters(self.shape)["control_points"]),)

    def with_control_points(self, points: Float) -> Buffers:
        """Vertices for control points (x, y, z, radius), flat Float (4P,), attached to them; before the instance's placement."""
        return Buffers(*tubes.tube_mesh(self.layout, self.plan.circles(points)))

    def statics(self) -> tuple[UInt32, ...]:
        return (mi.UInt32(parameters(self.shape)["segment_indices"]),)

    def sizes(self) -> tuple[int, ...]:
        return (len(parameters(self.shape)["control_points"]),)


Found = tuple[ShapeSource, np.ndarray]


def source_of(
    name: str, shape: mi.Shape, instance: mi.Shape | None, tessellation: int, known: dict[Any, Any] | None = None
) -> Found:
    """The source of a shape's vertices and its faces, uint32 (F, 3).

    Args:
        name: of the shape, for messages.
        shape, instance: the ``mi.Shape``, and the instance that places it in the world or None.
        tessellation: triangles around spheres, disks and cylinders. Curves have half as many around them, and B-splines an eighth
            of it along each segment.
        known: cache of data that shapes of one scene share, passed from call to call.

    Raises:
        UnsupportedShape: the shape is of another kind.
        ShadowmapError: a curve is broken.
    """
    known = {} if known is None else known
    if shape not in known:
        known[shape] = _new_source(name, shape, tessellation, known)
    source, faces = known[shape]
    return replace(source, instance=instance), faces


def _new_source(name: str, shape: mi.Shape, tessellation: int, known: dict[Any, Any]) -> Found:
    kind, instance = shape.class_name(), None
    if kind == "Rectangle":
        faces, _, _, texcoords = (buffer.numpy() for buffer in mesh_buffers(shape))
        # In its own space a rectangle has its corners at 2 uv - 1.
        uv = texcoords.reshape(-1, 2)
        if uv.tobytes() not in known:
            corners = (np.insert(2 * uv - 1, 2, 0, 1), np.tile(np.array([0, 0, 1], np.float32), (len(uv), 1)), uv)
            known[uv.tobytes()] = Buffers(*(device_array(mi.Float, a) for a in corners))
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


def _placed(buffers: Buffers, to_world: mi.Transform4f) -> Buffers:
    """Points transformed by ``to_world``, normals by its inverse transpose (and normalised)."""
    matrix = to_world.matrix
    offset = mi.Vector3f(matrix[0, 3], matrix[1, 3], matrix[2, 3])
    positions = mi.Vector3f(mi.Matrix3f(matrix) @ _vectors(buffers.positions)) + offset
    normals = buffers.normals
    if normals is not None:
        normals = ravel(dr.normalize(mi.Vector3f(mi.Matrix3f(to_world.inverse_transpose) @ _vectors(normals))))
    return Buffers(ravel(positions), normals, buffers.texcoords)


def _vectors(flat: Float) -> Vector3f:
    # Not ``dr.unravel``: its adjoint overwrites the gradients that other instances of the same buffer have added.
    return dr.gather(mi.Vector3f, flat, dr.arange(mi.UInt32, dr.width(flat) // 3))

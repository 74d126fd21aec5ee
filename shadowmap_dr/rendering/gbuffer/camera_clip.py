"""Clip-space vertices of a camera, and sample points on the surfaces that it sees."""

from __future__ import annotations

import math
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from ...jit.arrays import backend
from ...jit.broadcast import broadcast_differentiable
from ...jit.handover import interleaved
from ...jit.kernel_inputs import float_input, split, uint_input
from ...jit.types import Bool, Float, Point3f, Vector4f
from ...raster import DEPTH_GAP, NO_TRIANGLE, RasterOutput
from ...raster.triangle_setup import centred
from ...raster.types import by_pixel
from ...scene.geometry import Geometry
from ...scene.sensor import Sensor

# Depth range of orthographic cameras, in units of the farthest vertex's distance.
_ROOM = 1.01
# About this many pixels along each side of the image are sampled to find the part of the scene that is in view.
_SEEN_ACROSS = 128


def camera_clip(sensor: Sensor, geometry: Geometry) -> Float:
    """Clip-space vertices (Float, 4 V) for the rasterizer. Attached to vertices and camera.

    Depths differ from ``Sensor.view_projection``, whose near and far planes (0.01 and 10,000 by default) leave little of
    single precision: a perspective camera stores -near / distance, which keeps full relative precision at any distance, and an
    orthographic one spreads its range over the scene instead of up to the far plane.
    """
    projection, view = sensor.projection, sensor.view
    near = dr.detach(sensor.near)
    if sensor.kind == "perspective":
        depth = [0.0, 0.0, 0.0, -near]
    else:
        reach = _orthographic_reach(sensor, geometry)
        depth = [0.0, 0.0, 2 / reach, -1 - 2 * near / reach]
    rows = [[projection[r, c] for c in range(4)] for r in (0, 1, 3)]
    to_clip = mi.Matrix4f(rows[0], rows[1], depth, rows[2]) @ view
    lanes = geometry.vertex_count
    m = broadcast_differentiable(to_clip, lanes)
    p = dr.gather(mi.Point3f, geometry.positions, dr.arange(mi.UInt32, lanes))
    row = [dr.fma(m[r, 0], p.x, dr.fma(m[r, 1], p.y, dr.fma(m[r, 2], p.z, m[r, 3]))) for r in range(4)]
    # Identities written out: a row of zeros would still be multiplied with every vertex.
    return interleaved("positions in images", row)


def without_shapes(clip: Float, geometry: Geometry, shapes: Sequence[int]) -> Float:
    """Clip-space vertices (Float, 4 V), those of some shapes moved behind the camera, where no triangle is drawn."""
    lane = dr.arange(mi.UInt32, dr.width(clip))
    shape = dr.gather(mi.UInt32, geometry.vertex_shape, lane >> 2)
    hidden = mi.Bool(False)
    for each in shapes:
        hidden |= shape == each
    return dr.select(hidden, dr.select((lane & 3) == 3, mi.Float(-1), 0), clip)


def seen_points(sensor: Sensor, raster: RasterOutput, geometry: Geometry) -> tuple[Point3f, Bool]:
    """Points on what a camera sees (Point3f, world space) and which of them there are, at most about 128 x 128. Detached.

    They come from the rasterizer's depth planes, without the cost of interpolating the whole image.
    """
    with dr.suspend_grad():
        height, width, module = raster.height, raster.width, backend(raster.triangle)
        stride = max(1, math.ceil(math.sqrt(height * width) / _SEEN_ACROSS))
        columns, rows = -(-width // stride), -(-height // stride)
        lane = dr.arange(mi.UInt32, rows * columns)
        _, down, across = by_pixel(lane, 1, rows, columns)
        # One pixel of each cell of a lattice, at varying places in the cells: thin objects may lie along a row.
        cell, bottom, right = (
            uint_input(module, name, value) for name, value in (("stride", stride), ("height", height - 1), ("width", width - 1))
        )
        places = [split(5 * p + 2 * q, "stride", stride, 7 * max(rows, columns))[1] for p, q in ((across, down), (down, across))]
        row, column = dr.minimum(down * cell + places[0], bottom), dr.minimum(across * cell + places[1], right)
        triangle = dr.gather(mi.UInt32, raster.triangle, row * uint_input(module, "width", width) + column)
        hit = triangle != NO_TRIANGLE
        plane = raster.depth_plane(mi.UInt32(0), triangle, hit)
        x, y = centred(module, row, column, height, width)
        depth = dr.fma(plane[0], x, dr.fma(plane[1], y, plane[2]))
        x, y = x * float_input(module, "width", 2 / width), y * float_input(module, "height", 2 / height)
        near = dr.detach(sensor.near)
        projection = dr.detach(sensor.projection)
        if sensor.kind == "perspective":
            z = -near / dr.select(hit, depth, -1)
            local = mi.Point3f((x - projection[0, 2]) / projection[0, 0] * z, (y - projection[1, 2]) / projection[1, 1] * z, z)
            hit &= z <= dr.detach(sensor.far)
        else:
            z = dr.fma(0.5 * depth + 0.5, _orthographic_reach(sensor, geometry), near)
            local = mi.Point3f((x - projection[0, 3]) / projection[0, 0], (y - projection[1, 3]) / projection[1, 1], z)
        return mi.Transform4f(dr.detach(sensor.to_world.matrix)) @ local, hit


def eye_of(sensor: Sensor) -> Vector4f:
    """Place of a camera in homogeneous coordinates, world space: a point, or the direction to an orthographic one. Detached."""
    with dr.suspend_grad():
        to_world = mi.Transform4f(dr.detach(sensor.to_world.matrix))
        if sensor.kind == "perspective":
            return mi.Vector4f(*(to_world @ mi.Point3f(0)), 1)
        return mi.Vector4f(*(to_world @ mi.Vector3f(0, 0, -1)), 0)


def _orthographic_reach(sensor: Sensor, geometry: Geometry) -> Float:
    """Depth range of an orthographic camera: to the farthest vertex, or to the far plane if that is nearer. Detached."""
    with dr.suspend_grad():
        p = dr.gather(mi.Point3f, geometry.positions, dr.arange(mi.UInt32, geometry.vertex_count))
        # In camera units, since its transformation may scale. Positive even if no vertex lies in front of the camera.
        z = dr.abs((mi.Transform4f(sensor.view) @ p).z)
        farthest = dr.maximum(dr.max(dr.select(dr.isfinite(z), z, 0)), sensor.near)
        return dr.minimum(sensor.reach, _ROOM * farthest)


def least_gap(sensor: Sensor) -> float:
    """Least NDC depth of an edge in front of the surface behind it (:func:`~shadowmap_dr.raster.find_crossings`)."""
    # The depths of a perspective camera have the same relative precision at all distances.
    return 0.0 if sensor.kind == "perspective" else DEPTH_GAP


def within_far_plane(sensor: Sensor, depth: Float | None) -> Bool:
    """Mask of the pixels whose surface (``SurfacePoints.depth``) lies before a perspective camera's far plane."""
    return mi.Bool(True) if depth is None else depth <= dr.detach(sensor.far)

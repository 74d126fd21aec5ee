"""Clip-space vertices of a camera, and sample points on the surfaces that it sees."""

from __future__ import annotations

import math
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from ...jit.arrays import ravel
from ...jit.broadcast import broadcast_differentiable
from ...jit.types import Bool, Float, Point3f
from ...raster import DEPTH_GAP, NO_TRIANGLE, RasterOutput
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
    return ravel(mi.Point4f(*row))


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
        height, width = raster.height, raster.width
        stride = max(1, math.ceil(math.sqrt(height * width) / _SEEN_ACROSS))
        columns, rows = -(-width // stride), -(-height // stride)
        lane = dr.arange(mi.UInt32, rows * columns)
        down, across = lane // columns, lane % columns
        # One pixel of each cell of a lattice, at varying places in the cells: thin objects may lie along a row.
        row = dr.minimum(down * stride + (5 * across + 2 * down) % stride, height - 1)
        column = dr.minimum(across * stride + (5 * down + 2 * across) % stride, width - 1)
        triangle = dr.gather(mi.UInt32, raster.triangle, row * width + column)
        hit = triangle != NO_TRIANGLE
        plane = raster.depth_plane(mi.UInt32(0), triangle, hit)
        x, y = mi.Float(column) + 0.5, mi.Float(row) + 0.5
        depth = dr.fma(plane[0], x - 0.5 * width, dr.fma(plane[1], y - 0.5 * height, plane[2]))
        x, y = 2 / width * x - 1, 2 / height * y - 1
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

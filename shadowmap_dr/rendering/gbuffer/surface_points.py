"""Points on triangles that pixels see: the G-buffer before any shading.

``hits_at`` takes given barycentrics, attached or not. ``pixel_hits`` assumes that the points lie on the rays through a camera's
pixel centres, and differentiates in world space: a moving triangle carries the material point p_m = sum b_i p_i along, and the
ray o + t d then meets the triangle's plane at t = n.(p_m - o) / n.d. This equals the derivative of perspective-correct
barycentrics through clip space, and is much shorter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ...jit.arrays import replace_grad
from ...jit.branches import branch
from ...jit.types import AnyArray, ArrayT, Bool, Float, Point3f, UInt32, Vector3f, Vector3u
from ...jit.vectors import normalize_or
from ...scene.geometry import NO_TRIANGLE, Geometry
from ...scene.sensor import ImageSize, Sensor

#: Stands for directions to a camera where no camera was given.
NOT_GIVEN: Any = None  # Any: takes the place of an array


@dataclass(frozen=True)
class SurfacePoints:
    """Points on triangles of the soup, N of them.

    triangle     UInt32 (N,), 0xFFFFFFFF for none
    active       Bool (N,), false where nothing was hit; there all other fields are finite and meaningless
    changed      Bool (N,), true where vertices may have been replaced, or carry gradients
    face         Vector3u (N,), the triangle's vertices
    row          UInt32 (N,), or a constant: ``Geometry.row_of_copy``
    shape, flags UInt32 (N,), index of the shape and its ``ShapeInfo.flags``
    e1, e2       Vector3f (N,), vertices 1 and 2 minus vertex 0, attached
    n_face       Normal3f (N,), unit normal (p1 - p0) x (p2 - p0), attached
    u, v         Float (N,), barycentrics of vertices 1 and 2, attached
    p_world      Point3f (N,), attached
    wi_world     Vector3f (N,), unit vector to the camera, attached; None if no camera was given
    depth        Float (N,), distance along a perspective camera's axis, detached; None if there is no such camera
    pixel        Float (N,) or of width 1, height of the camera's pixels at that distance, world units, detached; None likewise
    sliding      False if it is known (on the host) that no point moves over a shape with textures, and none with such a shape
    """

    triangle: UInt32
    active: Bool
    changed: Bool
    face: Vector3u
    row: UInt32
    shape: UInt32
    flags: UInt32
    e1: Vector3f
    e2: Vector3f
    n_face: Vector3f
    u: Float
    v: Float
    p_world: Point3f
    wi_world: Vector3f = NOT_GIVEN
    depth: Float | None = None
    pixel: Float | None = None
    sliding: bool = True

    def corners(self, kind: type[ArrayT], buffer: AnyArray) -> tuple[ArrayT, ArrayT, ArrayT]:
        """A vertex attribute at vertex 0 and the differences of vertices 1 and 2 to it. Attached where vertices move.

        ``buffer`` has no copies (``Geometry.copies``).
        """
        return corner_values(kind, buffer, self.face, self.active, self.changed)

    def corners_of_copy(self, kind: type[ArrayT], buffer: AnyArray) -> tuple[ArrayT, ArrayT, ArrayT]:
        """As :meth:`corners`, from a buffer that has copies: normals, texture coordinates."""
        return corner_values(kind, buffer, self.face + self.row, self.active, self.changed)


def hits_at(geometry: Geometry, triangle: UInt32, u: Float, v: Float, active: Bool | bool = True) -> SurfacePoints:
    """Points with given barycentrics. Attached to them and to the positions."""
    active = mi.Bool(active) & (triangle != NO_TRIANGLE)
    face = dr.gather(mi.Vector3u, geometry.faces, triangle, active)
    shape, flags = geometry.shape_and_flags(triangle, active)
    u, v = dr.select(active, u, 0.0), dr.select(active, v, 0.0)
    row = geometry.row_of_copy(dr.width(triangle))
    origin, e1, e2 = geometry.triangle(face, active, row)
    p_world = origin + e1 * u + e2 * v
    return SurfacePoints(triangle, active, active, face, row, shape, flags, e1, e2, _normal(e1, e2), u, v, p_world)


def pixel_hits(geometry: Geometry, sensor: Sensor, triangle: UInt32, size: ImageSize) -> SurfacePoints:
    """Points that the pixel centres of pictures of a size see, one after the other, given their triangles (row-major).

    Attached to positions and camera: each point stays on the ray through its pixel and on its triangle's plane.
    """
    active = triangle != NO_TRIANGLE
    face, now = geometry.triangle_now(triangle, active)
    shape, flags = geometry.shape_and_flags(triangle, active)
    changed = active & geometry.has_changed(shape)
    ray_o, ray_d, pixel = sensor.pixel_rays(size.width, size.height, dr.width(triangle) // (size.width * size.height))
    row = geometry.row_of_copy(dr.width(triangle))

    def intersect(face: Vector3u, active: Bool, ray_o: Point3f, ray_d: Vector3f, row: UInt32) -> tuple[Any, ...]:
        return _intersect(geometry.triangle(face, active, row), active, ray_o, ray_d)

    attached, moving = dr.grad_enabled(geometry.positions), dr.grad_enabled(ray_o, ray_d)
    if attached and moving:
        found = intersect(face, active, ray_o, ray_d, row)
    else:
        found = _intersect(now, active, ray_o, ray_d)
    if attached and not moving:
        # The types only: a function that holds the arrays would keep the whole AD graph alive if nothing ever traverses it.
        kinds = [type(value) for value in found]

        def none(face: Vector3u, active: Bool, ray_o: Point3f, ray_d: Vector3f, row: UInt32) -> tuple[Any, ...]:
            return tuple(dr.zeros(kind) for kind in kinds)

        # Derivatives separately, in a branch: in many images most pixels see nothing that moves.
        moved = branch(changed, intersect, none, (face, changed, ray_o, ray_d, row), "attached hits")
        found = tuple(replace_grad(value, other) for value, other in zip(found, moved, strict=True))
    e1, e2, normal, u, v, p_world = found
    wi_world = -dr.normalize(ray_d)
    # Directions have unit length along the axis, so the ray's parameter is the depth.
    depth = None
    if sensor.kind == "perspective":
        d = dr.detach(ray_d)
        depth = dr.dot(dr.detach(p_world) - dr.detach(ray_o), d) * dr.rcp(dr.squared_norm(d))
        pixel *= depth
    return SurfacePoints(
        *(triangle, active, changed, face, row, shape, flags, e1, e2, normal, u, v, p_world, wi_world, depth, pixel),
        sliding=moving or geometry.attached_places(),
    )


def _intersect(
    triangle: tuple[Point3f, Vector3f, Vector3f], active: Bool, ray_o: Point3f, ray_d: Vector3f
) -> tuple[Any, Any, Any, Any, Any, Any]:
    """Intersections of rays with the planes of their triangles."""
    first, e1, e2 = triangle
    with dr.suspend_grad():
        q, a, b, o, d = (dr.detach(x) for x in (first, e1, e2, ray_o, ray_d))
        n = dr.cross(a, b)
        across = dr.dot(n, d)
        edge_on = ~(dr.abs(across) > 0)
        inverse = dr.rcp(dr.select(edge_on, 1, across))
        s = o - q
        # The rasterizer found the pixel inside: rounding, on triangles seen edge-on, must not move the point outside.
        u = dr.maximum(dr.dot(d, dr.cross(s, b)) * inverse, 0)
        v = dr.maximum(dr.dot(d, dr.cross(a, s)) * inverse, 0)
        excess = dr.rcp(dr.maximum(u + v, 1))
        u, v = dr.select(active, u * excess, 0), dr.select(active, v * excess, 0)
        # The derivative is infinite where a triangle is seen exactly edge-on: it is set to 0.
        inverse = dr.select(edge_on, 0, inverse)
        area2 = dr.squared_norm(n)
        dual = dr.select(area2 > 0, dr.rcp(area2), 0)
        dual_u, dual_v = dr.cross(b, n) * dual, dr.cross(n, a) * dual
    p_material = first + e1 * u + e2 * v
    p_world = p_material
    if dr.grad_enabled(p_material, ray_o, ray_d):
        # n may stay detached: it is multiplied with the (vanishing) distance of the ray's point from the plane.
        if dr.grad_enabled(ray_o, ray_d):
            t = dr.dot(n, dr.detach(p_material) - o) * inverse
            on_ray = ray_o + ray_d * (t + dr.dot(n, p_material - ray_o - ray_d * t) * inverse)
        else:
            on_ray = d * (dr.dot(n, p_material) * inverse)
        p_world = replace_grad(p_material, mi.Point3f(on_ray))
        slide = p_world - p_material
        u = replace_grad(u, dr.dot(slide, dual_u))
        v = replace_grad(v, dr.dot(slide, dual_v))
    return e1, e2, _normal(e1, e2), u, v, p_world


def _normal(e1: Vector3f, e2: Vector3f) -> Vector3f:
    return normalize_or(mi.Normal3f(dr.cross(e1, e2)), mi.Normal3f(0.0, 0.0, 1.0))


def corner_values(
    kind: type[ArrayT], buffer: AnyArray, face: Vector3u, active: Bool | bool, changed: Bool
) -> tuple[ArrayT, ArrayT, ArrayT]:
    """A vertex attribute at the first of three vertices (``face``) and the differences of the others to it.

    ``buffer`` is flat, ``kind`` the type of its entries; gradients flow only where vertices may have ``changed``.
    """
    values: list[Any] = [dr.gather(kind, buffer, face[k], active) for k in range(3)]
    if dr.grad_enabled(buffer):
        # Values for all lanes, gradients only where vertices may have changed: scattering gradients back costs most.
        values = [replace_grad(dr.detach(x), dr.gather(kind, buffer, face[k], changed)) for k, x in enumerate(values)]
    first, second, third = values
    return first, second - first, third - first

"""Surface records: the surface that each pixel sees, with its material."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ...jit.arrays import backend, ravel
from ...jit.branches import branch
from ...jit.broadcast import broadcast_differentiable, copy_of_lane, in_copies, like_lanes
from ...jit.types import Bool, Color3f, Float, Normal3f, Point3f, UInt32, Vector3f, Vector3u
from ...jit.vectors import normalize_or
from ...scene.geometry import FACETED, FLIP_GEOMETRIC, FLIP_SHADING, HAS_NORMALS, HAS_TEXCOORDS, READS_ATTRIBUTES, Geometry
from ...scene.load import SceneData
from ...scene.sensor import Sensor
from ...scene.sums import evaluate
from .surface_points import SurfacePoints, corner_values, hits_at

# The BSDFs of fewer shapes are called one by one. That runs faster, but the program grows with their number.
_MANY_SHAPES = 128


@dataclass(frozen=True)
class Surface:
    """Surfaces seen at each pixel, N of them.

    p_world  Point3f (N,), attached to vertices and barycentrics
    n_world  Normal3f (N,), unit geometric normal, on the side that the shape calls outside
    wi_world Vector3f (N,), unit vector to the camera
    shape    UInt32 (N,), index into ``geometry.shapes``
    active   Bool (N,), false where nothing was hit; there all other fields are finite and meaningless
    si       mi.SurfaceInteraction3f, for BSDF evaluation. ``si.p`` is the *rest-pose* position for shapes with mesh attributes
    bsdf     mi.BSDFPtr (N,)
    colour   colour (N,), the BSDF on the viewer's side over the cosine, if no BSDF depends on directions otherwise; else None
    """

    p_world: Point3f
    n_world: Vector3f
    wi_world: Vector3f
    shape: UInt32
    active: Bool
    si: mi.SurfaceInteraction3f
    bsdf: mi.BSDFPtr
    colour: Color3f | None = None

    def evaluate(self, wo: Vector3f, active: Bool) -> Color3f:
        """BSDF times cosine (colour, N) for directions to the light in the local frame (Vector3f). Attached to all."""
        if self.colour is None:
            return mi.UnpolarizedSpectrum(self.bsdf.eval(mi.BSDFContext(), self.si, wo, active))
        # NaN directions give NaN, as BSDFs do: a broken light must not look like a dark one.
        return dr.select(active & ~(self.si.wi.z * wo.z <= 0), self.colour * dr.abs(wo.z), 0)


def plain_colours(data: SceneData) -> Float:
    """Values of Mitsuba's BSDFs for light and viewer along the normal, on either side of each shape.

    They determine a BSDF that is proportional to the cosine (:attr:`SceneData.needs_frames`), and evaluating two directions is
    much cheaper than evaluating each pixel. Float (8 S,), four numbers for each side, attached.
    """
    bsdfs = [source.shape.bsdf() for source in data.sources]
    lane = dr.arange(mi.UInt32, 2 * len(bsdfs))
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(lane))
    normal = mi.Vector3f(0, 0, dr.select((lane & 1) == 0, 1, -1))
    si.n = mi.Normal3f(0, 0, 1)
    si.sh_frame = mi.Frame3f(mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1))
    si.wi = normal
    if len(bsdfs) > _MANY_SHAPES and not dr.flag(dr.JitFlag.FreezingScope):
        pointer = dr.gather(mi.BSDFPtr, data.bsdf_ptr, lane >> 1)
        colour = mi.UnpolarizedSpectrum(pointer.eval(mi.BSDFContext(), si, normal))
    else:
        # One by one: replays of frozen functions give wrong results for calls through pointers in small kernels.
        colour = dr.zeros(mi.UnpolarizedSpectrum, dr.width(lane))
        known: dict[Any, Any] = {}
        for shape, bsdf in enumerate(bsdfs):
            if bsdf not in known:
                known[bsdf] = mi.UnpolarizedSpectrum(bsdf.eval(mi.BSDFContext(), si, normal))
            colour = dr.select(lane >> 1 == shape, known[bsdf], colour)
    result = ravel(mi.Vector4f(*colour, *(mi.Float(0) for _ in range(4 - len(colour)))))
    dr.eval(result)
    return result


def surface(
    data: SceneData, geometry: Geometry, sensor: Sensor, triangle: UInt32, u: Float, v: Float, active: Bool | bool = True
) -> Surface:
    """Surface records for triangles of the soup.

    ``triangle`` UInt32 (N,), 0xFFFFFFFF for none; ``u``, ``v`` Float (N,), barycentrics of the triangle's vertices 1 and 2.
    ``geometry`` is ``data.geometry`` or one derived from it.
    Gradients flow to positions, normals, texture coordinates, u, v and the sensor.
    Fields agree with ``compute_surface_interaction`` of Mitsuba for the same triangle and barycentrics.
    """
    hits = hits_at(geometry, triangle, u, v, active)
    hits = replace(hits, wi_world=broadcast_differentiable(sensor, dr.width(triangle)).wi_world(hits.p_world))
    return surface_at(data, geometry, sensor, hits, *normals_at(geometry, hits))


def normals_at(geometry: Geometry, hits: SurfacePoints) -> tuple[Normal3f, Normal3f]:
    """(geometric, shading) unit normals (Normal3f, N) on the side that each shape calls outside. Attached."""
    flags = _Flags(geometry, hits.flags)
    n_world = flags.negate(FLIP_GEOMETRIC, hits.n_face)
    infos = geometry.shapes
    if not any(info.has_normals for info in infos):
        return n_world, n_world

    def interpolated(
        face: Vector3u, changed: Bool, u: Float, v: Float, n_world: Vector3f, negative: Bool, active: Bool | bool = True
    ) -> Normal3f:
        first, d1, d2 = corner_values(mi.Vector3f, geometry.normals, face, active, changed)
        normal = normalize_or(first + d1 * u + d2 * v, mi.Vector3f(0.0))
        return mi.Normal3f(dr.select(dr.squared_norm(normal) > 0, dr.select(negative, -normal, normal), n_world))

    arguments = (hits.face + hits.row, hits.changed, hits.u, hits.v, n_world, flags.test(FLIP_SHADING))
    needed = hits.active & flags.test(HAS_NORMALS)
    if any(info.faceted and geometry.known_unchanged(info) for info in infos):
        needed &= ~flags.test(FACETED) | hits.changed
    elif all(info.has_normals for info in infos):
        return n_world, interpolated(*arguments, hits.active)
    return n_world, branch(needed, interpolated, lambda *args: mi.Normal3f(args[4]), arguments, "smooth normals")


def surface_at(
    data: SceneData,
    geometry: Geometry,
    sensor: Sensor,
    hits: SurfacePoints,
    n_world: Vector3f,
    n_shading: Vector3f,
    *,
    frames: bool = True,
) -> Surface:
    """Surface records for points on triangles, with the normals of :func:`normals_at`. Attached to all of these.

    ``frames``: compute tangents and texture coordinates. Without them, ``si`` suits only materials that depend on nothing but
    cosines (:attr:`shadowmap_dr.scene.load.SceneData.needs_frames`).
    """
    active, shape = hits.active, hits.shape
    flags = _Flags(geometry, hits.flags)
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(hits.triangle))
    if frames:
        si.uv, si.dp_du, si.dp_dv = _parametrisation(geometry, flags, hits)
        tangent = si.dp_du - n_shading * dr.dot(n_shading, si.dp_du)
        tangent = normalize_or(tangent, mi.coordinate_system(n_shading)[0])
        si.sh_frame = mi.Frame3f(tangent, dr.cross(n_shading, tangent), n_shading)
    else:
        si.sh_frame = mi.Frame3f(mi.Vector3f(0), mi.Vector3f(0), n_shading)
    si.t = dr.select(active, dr.norm(sensor.origin - hits.p_world), dr.inf)
    si.p = _interaction_position(geometry, flags, hits)
    if not hits.sliding:
        # Textures are not asked for derivatives that are zero.
        si.p, si.uv = dr.detach(si.p), dr.detach(si.uv)
    si.n = flags.negate(FLIP_GEOMETRIC, hits.n_face)
    si.wi = si.to_local(hits.wi_world)
    si.shape = dr.gather(mi.ShapePtr, data.shape_ptr, shape, active)
    si.prim_index = hits.triangle - dr.gather(mi.UInt32, geometry.shape_face_start, shape, active)
    bsdf = dr.gather(mi.BSDFPtr, data.bsdf_ptr, shape, active)
    return coloured(data, Surface(hits.p_world, n_world, hits.wi_world, shape, active, si, bsdf), frames)


def coloured(data: SceneData, seen: Surface, frames: bool) -> Surface:
    """The same surfaces with the materials' current colours, if materials depend on cosines only. Attached to both.

    It reads these fields of ``seen``: ``shape``, ``bsdf``, ``active`` and ``si.wi.z``; with ``frames`` (as in :func:`surface_at`)
    also the inputs of textures: ``si.p``, ``si.uv``, ``si.prim_index`` and ``si.shape``.
    """
    if not frames:
        return replace(seen, colour=_plain_colour(data, seen))
    return replace(seen, colour=_cosine_colour(data, seen)) if data.only_cosines else seen


def _plain_colour(data: SceneData, seen: Surface) -> Color3f:
    """``Surface.colour`` of materials without textures."""
    width, table, channels = dr.width(seen.shape), plain_colours(data), dr.size_v(mi.UnpolarizedSpectrum)
    rows = dr.width(table) // 4
    block = like_lanes(width)
    (sides,), copies = in_copies([table], width, block)
    row = copy_of_lane(backend(sides), width, copies, block) * rows
    row += 2 * seen.shape + dr.select(seen.si.wi.z < 0, mi.UInt32(1), 0)
    colour = dr.gather(mi.Vector4f, sides, row, seen.active, mode=dr.ReduceMode.Local)
    return mi.UnpolarizedSpectrum(*(colour[c] for c in range(channels)))


def _cosine_colour(data: SceneData, seen: Surface) -> Color3f:
    """``Surface.colour`` of materials with textures: their values for light along the normal.

    They receive only the inputs of textures, since derivatives keep all inputs in memory.
    """
    si, width = seen.si, dr.width(seen.shape)

    def colour(own: tuple[Any, ...]) -> Color3f:
        p, uv, primitive, shape, bsdf, behind, active = own
        at = dr.zeros(mi.SurfaceInteraction3f, dr.width(active))
        at.p, at.uv, at.prim_index, at.shape = p, uv, primitive, shape
        at.n = mi.Normal3f(0, 0, 1)
        at.sh_frame = mi.Frame3f(mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1))
        at.wi = mi.Vector3f(0, 0, dr.select(behind, mi.Float(-1), 1))
        return mi.UnpolarizedSpectrum(bsdf.eval(mi.BSDFContext(), at, at.wi, active))

    own = (si.p, si.uv, si.prim_index, si.shape, seen.bsdf, si.wi.z < 0, seen.active)
    return evaluate(colour, own, data.materials, width)


def _parametrisation(geometry: Geometry, flags: _Flags, hits: SurfacePoints) -> tuple[Any, Any, Any]:
    """(texture coordinates, derivatives of the position by u and by v); on shapes without any, uv are the barycentrics."""
    uv, dp_du, dp_dv = mi.Point2f(hits.u, hits.v), mi.Vector3f(hits.e1), mi.Vector3f(hits.e2)
    if not any(info.has_texcoords for info in geometry.shapes):
        return uv, dp_du, dp_dv
    has = flags.test(HAS_TEXCOORDS)
    first, d1, d2 = hits.corners_of_copy(mi.Point2f, geometry.texcoords)
    uv = dr.select(has, first + d1 * hits.u + d2 * hits.v, uv)
    det = d1.x * d2.y - d1.y * d2.x
    regular = has & (det != 0)
    inverse = dr.rcp(dr.select(regular, det, 1.0))
    any_du, any_dv = mi.coordinate_system(hits.n_face)
    dp_du = dr.select(has, dr.select(regular, (hits.e1 * d2.y - hits.e2 * d1.y) * inverse, any_du), dp_du)
    dp_dv = dr.select(has, dr.select(regular, (hits.e2 * d1.x - hits.e1 * d2.x) * inverse, any_dv), dp_dv)
    return uv, dp_du, dp_dv


class _Flags:
    """Per-pixel booleans of the shape, read only if shapes of the scene differ in them."""

    def __init__(self, geometry: Geometry, flags: UInt32) -> None:
        self._static = [info.flags for info in geometry.shapes]
        self._flags = flags

    def any(self, bit: int) -> bool:
        return any(flags & bit for flags in self._static)

    def test(self, bit: int) -> Bool:
        if all(flags & bit for flags in self._static):
            return mi.Bool(True)
        if not self.any(bit):
            return mi.Bool(False)
        return (self._flags & bit) != 0

    def negate(self, bit: int, vector: Vector3f) -> Vector3f:
        """-vector where the bit is set."""
        return dr.select(self.test(bit), -vector, vector) if self.any(bit) else vector


def _interaction_position(geometry: Geometry, flags: _Flags, hits: SurfacePoints) -> Point3f:
    """World position; for shapes with mesh attributes, rest-pose position, from which Mitsuba recovers barycentrics."""
    if not flags.any(READS_ATTRIBUTES):
        return hits.p_world
    assert geometry.rest_positions is not None, "read where meshes have attributes"
    first, d1, d2 = hits.corners(mi.Point3f, geometry.rest_positions)
    return dr.select(flags.test(READS_ATTRIBUTES), first + d1 * hits.u + d2 * hits.v, hits.p_world)

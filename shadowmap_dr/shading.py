"""From what the rasterizer saw to radiance: surface records, direct light, ambient light, background.

Mitsuba's own ``bsdf.eval`` does the shading, on ``mi.SurfaceInteraction3f`` records that are filled here from the triangle soup.
Mitsuba's mesh buffers and its ray tracing are never used, so moving vertices costs nothing but the soup's new positions.
All functions are made of pure, traced operations: no value is read back, every array is as long as there are pixels, and all of
it may run in a frozen function.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from .environments import Environment
from .geometry import FACETED, FLIP_GEOMETRIC, FLIP_SHADING, HAS_NORMALS, HAS_TEXCOORDS, READS_ATTRIBUTES, Geometry, normalize_or
from .hits import Hits, corner_values, hits_at
from .lights import AreaLight, Light
from .raster._types import backend
from .scene import SceneData
from .sensors import Sensor
from .spread import spread
from .sums import evaluate
from .tables import LIKE_LANES, copy_of_lane, in_copies

# The BSDFs of fewer shapes are called one by one: quicker again and again, but their program grows with their number.
_MANY_SHAPES = 128


@dataclass(frozen=True)
class Surface:
    """What is seen at each pixel, N of them.

    p_world  Point3f (N,), attached to vertices and barycentrics
    n_world  Normal3f (N,), unit geometric normal, on the side that the shape calls outside
    wi_world Vector3f (N,), unit vector to the camera
    shape    UInt32 (N,), index into ``geometry.shapes``
    active   Bool (N,), false where nothing was hit; there all records are finite and meaningless
    si       mi.SurfaceInteraction3f, for BSDF evaluation. ``si.p`` is the *rest-pose* position for shapes with mesh attributes
    bsdf     mi.BSDFPtr (N,)
    colour   colour (N,), the BSDF on the viewer's side over the cosine, if no BSDF depends on directions otherwise; else None
    """

    p_world: Any
    n_world: Any
    wi_world: Any
    shape: Any
    active: Any
    si: Any
    bsdf: Any
    colour: Any = None

    def evaluate(self, wo: Any, active: Any) -> Any:
        """BSDF times cosine (colour, N) for directions to the light in the local frame (Vector3f). Attached to all."""
        if self.colour is None:
            return mi.UnpolarizedSpectrum(self.bsdf.eval(mi.BSDFContext(), self.si, wo, active))
        # Directions that are NaN give NaN, as BSDFs do: a broken light is not just dark.
        return dr.select(active & ~(self.si.wi.z * wo.z <= 0), self.colour * dr.abs(wo.z), 0)


def plain_colours(data: SceneData) -> Any:
    """What Mitsuba's BSDFs return for light and viewer along the normal, on either side of each shape.

    That is all there is to know about a BSDF that is proportional to the cosine (:attr:`SceneData.needs_frames`), and calling
    it for two directions is much cheaper than for each pixel. Float (8 S,), four numbers for each side, attached.
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
        # One by one: calls through pointers in small kernels come out wrong when a frozen function is replayed.
        colour = dr.zeros(mi.UnpolarizedSpectrum, dr.width(lane))
        known: dict[Any, Any] = {}
        for shape, bsdf in enumerate(bsdfs):
            if bsdf not in known:
                known[bsdf] = mi.UnpolarizedSpectrum(bsdf.eval(mi.BSDFContext(), si, normal))
            colour = dr.select(lane >> 1 == shape, known[bsdf], colour)
    result = dr.ravel(mi.Vector4f(*colour, *(mi.Float(0) for _ in range(4 - len(colour)))))
    dr.eval(result)
    return result


def surface(data: SceneData, geometry: Geometry, sensor: Sensor, triangle: Any, u: Any, v: Any, active: Any = True) -> Surface:
    """Surface records for triangles of the soup.

    ``triangle`` UInt32 (N,), 0xFFFFFFFF for none; ``u``, ``v`` Float (N,), barycentrics of the triangle's vertices 1 and 2.
    ``geometry`` is ``data.geometry`` or one derived from it.
    Gradients flow to positions, normals, texture coordinates, u, v and the sensor.
    Fields agree with ``compute_surface_interaction`` of Mitsuba for the same triangle and barycentrics.
    """
    hits = hits_at(geometry, triangle, u, v, active)
    hits = replace(hits, wi_world=spread(sensor, dr.width(triangle)).wi_world(hits.p_world))
    return surface_at(data, geometry, sensor, hits, *normals_at(geometry, hits))


def normals_at(geometry: Geometry, hits: Hits) -> tuple[Any, Any]:
    """(geometric, shading) unit normals (Normal3f, N) on the side that each shape calls outside. Attached."""
    flags = _Flags(geometry, hits.flags)
    n_world = flags.negate(FLIP_GEOMETRIC, hits.n_face)
    infos = geometry.shapes
    if not any(info.has_normals for info in infos):
        return n_world, n_world

    def interpolated(face: Any, changed: Any, u: Any, v: Any, n_world: Any, negative: Any, active: Any = True) -> Any:
        first, d1, d2 = corner_values(mi.Vector3f, geometry.normals, face, active, changed)
        normal = normalize_or(first + d1 * u + d2 * v, mi.Vector3f(0.0))
        return mi.Normal3f(dr.select(dr.squared_norm(normal) > 0, dr.select(negative, -normal, normal), n_world))

    arguments = (hits.face + hits.row, hits.changed, hits.u, hits.v, n_world, flags.test(FLIP_SHADING))
    needed = hits.active & flags.test(HAS_NORMALS)
    if any(info.faceted and geometry.known_unchanged(info) for info in infos):
        needed &= ~flags.test(FACETED) | hits.changed
    elif all(info.has_normals for info in infos):
        return n_world, interpolated(*arguments, hits.active)
    return n_world, dr.if_stmt(
        arguments, needed, interpolated, lambda *args: mi.Normal3f(args[4]), mode="symbolic", label="smooth normals"
    )


def surface_at(
    data: SceneData, geometry: Geometry, sensor: Sensor, hits: Hits, n_world: Any, n_shading: Any, *, frames: bool = True
) -> Surface:
    """Surface records for points on triangles, with the normals of :func:`normals_at`. Attached to all of these.

    ``frames``: whether tangents and texture coordinates are needed; without them ``si`` serves materials only that know nothing
    but cosines (:attr:`shadowmap_dr.scene.SceneData.needs_frames`).
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
    si.n = flags.negate(FLIP_GEOMETRIC, hits.n_face)
    si.wi = si.to_local(hits.wi_world)
    si.shape = dr.gather(mi.ShapePtr, data.shape_ptr, shape, active)
    si.prim_index = hits.triangle - dr.gather(mi.UInt32, geometry.shape_face_start, shape, active)
    bsdf = dr.gather(mi.BSDFPtr, data.bsdf_ptr, shape, active)
    seen = Surface(hits.p_world, n_world, hits.wi_world, shape, active, si, bsdf)
    if not frames:
        return replace(seen, colour=_plain_colour(data, seen))
    return replace(seen, colour=_cosine_colour(data, seen)) if data.only_cosines else seen


def _plain_colour(data: SceneData, seen: Surface) -> Any:
    """``Surface.colour`` of materials that are the same everywhere on a shape."""
    width, sides, channels = dr.width(seen.shape), plain_colours(data), dr.size_v(mi.UnpolarizedSpectrum)
    rows = dr.width(sides) // 4
    (sides,), copies = in_copies([sides], width, LIKE_LANES)
    row = copy_of_lane(backend(sides), width, copies, LIKE_LANES) * rows
    row += 2 * seen.shape + dr.select(seen.si.wi.z < 0, mi.UInt32(1), 0)
    colour = dr.gather(mi.Vector4f, sides, row, seen.active, mode=dr.ReduceMode.Local)
    return mi.UnpolarizedSpectrum(*(colour[c] for c in range(channels)))


def _cosine_colour(data: SceneData, seen: Surface) -> Any:
    """``Surface.colour`` of materials with textures: what they return for light along the normal.

    They are given what textures read, and no more: derivatives keep all of it in memory.
    """
    si, width = seen.si, dr.width(seen.shape)

    def colour(own: tuple[Any, ...]) -> Any:
        p, uv, primitive, shape, bsdf, behind, active = own
        at = dr.zeros(mi.SurfaceInteraction3f, dr.width(active))
        at.p, at.uv, at.prim_index, at.shape = p, uv, primitive, shape
        at.n = mi.Normal3f(0, 0, 1)
        at.sh_frame = mi.Frame3f(mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1))
        at.wi = mi.Vector3f(0, 0, dr.select(behind, mi.Float(-1), 1))
        return mi.UnpolarizedSpectrum(bsdf.eval(mi.BSDFContext(), at, at.wi, active))

    own = (si.p, si.uv, si.prim_index, si.shape, seen.bsdf, si.wi.z < 0, seen.active)
    return evaluate(colour, own, data.materials(), width)


def _parametrisation(geometry: Geometry, flags: _Flags, hits: Hits) -> tuple[Any, Any, Any]:
    """Texture coordinates and the derivatives of the position by them; a shape without any has uv = barycentrics."""
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


def direct_light(surface: Surface, light: Light, visibility: Any = 1.0, nodes: Sequence[Any] = (), *, gate: bool = True) -> Any:
    """Radiance (colour, N) towards the camera of one light: BSDF * light * visibility.

    ``visibility`` Float (N,), 0 dark to 1 lit. ``nodes``: :meth:`SceneData.materials`. ``gate`` removes
    light that reaches the shading normal from the wrong side of the triangle, as a shadow ray would. Gradients flow to all of
    surface, light and visibility, not through the gate.
    """
    wo_world, weight = spread(light, dr.width(surface.shape)).illuminate(surface.p_world, surface.active)
    wo = surface.si.to_local(wo_world)
    active = mi.Bool(surface.active)
    if gate:
        active &= passes_gate(surface, wo_world, wo)
    return dr.select(active, _reflected(surface, wo, active, nodes) * weight * visibility, 0.0)


def _reflected(surface: Surface, wo: Any, active: Any, nodes: Sequence[Any]) -> Any:
    """:meth:`Surface.evaluate` with derivatives by parameters of ``nodes`` that add up without loss."""
    if surface.colour is not None:
        return surface.evaluate(wo, active)
    return evaluate(lambda own: own[0].evaluate(*own[1:]), (surface, wo, mi.Bool(active)), nodes, dr.width(surface.shape))


def passes_gate(surface: Surface, wo_world: Any, wo: Any) -> Any:
    """Bool (N,): where no light comes through the triangle's wrong side; ``wo``: the same direction in the shading frame."""
    # Light and viewer lie on the same side of the triangle exactly where they lie on the same side by the shading normal.
    # Holds for reflection and transmission, and for triangles whose vertex normals point the other way.
    with dr.suspend_grad():
        sides = dr.dot(surface.n_world, wo_world) * dr.dot(surface.n_world, surface.wi_world)
        return (sides > 0) == (wo.z * surface.si.wi.z > 0)


def emission(surface: Surface, lights: Sequence[AreaLight]) -> Any:
    """Radiance (colour, N) that surfaces give off themselves, seen from the camera. Attached to surface and lights.

    Faces shine on the side on which their vertex normals are. Mitsuba asks the interpolated normal itself, which turns away
    before the outline of a smooth shape is reached: the dark rim hides the outline, and with it what a moving lamp changes.
    """
    total = dr.zeros(mi.UnpolarizedSpectrum, dr.width(surface.shape))
    with dr.suspend_grad():
        towards = dr.dot(surface.n_world, surface.wi_world) * dr.dot(surface.n_world, surface.si.sh_frame.n)
        front = surface.active & (towards > 0)
    si = mi.SurfaceInteraction3f(surface.si)
    si.wi = mi.Vector3f(0, 0, 1)
    for light in lights:
        own = front & (surface.shape == light.shape)
        radiance = evaluate(lambda at, light=light: light.seen(*at), (si, own), [light.emitter], dr.width(surface.shape))
        total += dr.select(own, radiance, 0)
    return total


def ambient_light(surface: Surface, environment: Environment, n_directions: int = 16, nodes: Sequence[Any] = ()) -> Any:
    """Radiance (colour, N) towards the camera of an environment that nothing shadows.

    A fixed set of ``n_directions`` cosine-distributed directions in the hemisphere of the shading normal on the viewer's side
    (Fibonacci spiral): exact for diffuse surfaces under constant light, coarse for gloss. Gradients flow to surface and emitter.
    ``nodes``: :meth:`SceneData.materials`.
    """
    total = dr.zeros(mi.UnpolarizedSpectrum, dr.width(surface.shape))
    side = dr.select(surface.si.wi.z < 0, -1.0, mi.Float(1.0))
    for i in range(n_directions):
        radius = math.sqrt((i + 0.5) / n_directions)
        angle = i * math.pi * (3.0 - math.sqrt(5.0))
        cosine = math.sqrt(1.0 - radius * radius)
        wo = mi.Vector3f(radius * math.cos(angle), radius * math.sin(angle), cosine * side)
        radiance = environment.radiance(surface.si.to_world(wo), surface.active)
        total += _reflected(surface, wo, surface.active, nodes) * radiance * (math.pi / (cosine * n_directions))
    return dr.select(surface.active, total, 0.0)


def background(environment: Environment, sensor: Sensor, width: int | None = None, height: int | None = None) -> Any:
    """Radiance (colour, H * W) of an environment at every pixel centre, as seen where nothing is in front of it."""
    towards = sensor.ray_direction(width, height)
    return evaluate(environment.radiance, towards, environment.nodes, dr.width(towards))


def opacity(surface: Surface) -> Any:
    """Float (N,): 1 where the surface is solid, 0 where its BSDF (``mask``, ``null``) lets everything through unchanged.

    Gradients flow to the BSDF's opacity. Alpha tests compare this with 0.5.
    """
    through = surface.bsdf.eval_null_transmission(surface.si, surface.active)
    return dr.select(surface.active, 1.0 - dr.mean(mi.UnpolarizedSpectrum(through)), 0.0)


class _Flags:
    """Per-pixel booleans of the shape, looked at only if shapes of the scene differ in them."""

    def __init__(self, geometry: Geometry, flags: Any) -> None:
        self._static = [info.flags for info in geometry.shapes]
        self._flags = flags

    def any(self, bit: int) -> bool:
        return any(flags & bit for flags in self._static)

    def test(self, bit: int) -> Any:
        if all(flags & bit for flags in self._static):
            return mi.Bool(True)
        if not self.any(bit):
            return mi.Bool(False)
        return (self._flags & bit) != 0

    def negate(self, bit: int, vector: Any) -> Any:
        """-vector where the bit is set."""
        return dr.select(self.test(bit), -vector, vector) if self.any(bit) else vector


def _interaction_position(geometry: Geometry, flags: _Flags, hits: Hits) -> Any:
    """World position; rest-pose position for shapes with mesh attributes, since Mitsuba recovers barycentrics from it."""
    if not flags.any(READS_ATTRIBUTES):
        return hits.p_world
    first, d1, d2 = hits.corners(mi.Point3f, geometry.rest_positions)
    return dr.select(flags.test(READS_ATTRIBUTES), first + d1 * hits.u + d2 * hits.v, hits.p_world)

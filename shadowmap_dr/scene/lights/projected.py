"""Projectors, and beams: flat shapes that shine along their normals."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ...jit.types import Bool, Color3f, Float, Point2f, Point3f, Vector2f, Vector3f
from ...jit.vectors import normalize_or
from ...shadow.light_camera import LightView, directional_view
from ..transforms import axis, translation
from .light import cone_kind, cone_views, picture, towards
from .soft_outline import BoundedLight, share_inside

# Width of the rim in which light fades, half of it on either side of the outline: the rim gives a moving outline derivatives.
# In units of the picture, and of the narrower half of a beam's cross-section. In images the rim is at least as wide as a pixel.
_PICTURE_RIM = 1 / 1024
_BEAM_RIM = 0.005
# Distance of the first casters from a beam's shape, in units of its reach.
_BEAM_START = 1e-3


@dataclass(frozen=True)
class Projector(BoundedLight):
    """A picture thrown along the local +z axis: Mitsuba's ``projector``.

    to_world    Transform4f
    irradiance  ``mi.Texture``: the picture, as irradiance on a plane at local z = 1 (times pi, as in Mitsuba)
    scale       Float, factor of the irradiance
    tangents    Vector2f, tangents of the half-angles that the picture covers, in local x and y
    falloff_width  width of the rim in which the light fades, half of it on either side of the outline, in units of the picture's
                width and height. The rim gives a moving outline derivatives. Outside the rim the light is as in Mitsuba.
    """

    name: str
    to_world: mi.Transform4f
    irradiance: mi.Texture
    scale: Float
    tangents: Vector2f
    falloff_width: float = _PICTURE_RIM
    widest: float = 0.5

    @property
    def position(self) -> Point3f:
        """Point3f, world space."""
        return translation(self.to_world)

    @property
    def direction(self) -> Vector3f:
        """Vector3f, unit axis, the direction in which light travels, world space."""
        return dr.normalize(axis(self.to_world, 2))

    @property
    def spread(self) -> Float:
        """Float, tangent of the half-angle of the smallest cone about the axis with a square base that holds the picture."""
        x, y, z = (dr.norm(axis(self.to_world, k)) for k in range(3))
        return dr.maximum(self.tangents.x * x, self.tangents.y * y) * (1 + self.falloff_width) / z

    def illuminate(self, p_world: Point3f, active: Bool | bool = True, inside: Float | None = None) -> tuple[Vector3f, Color3f]:
        """(wo, weight): unit direction to the projector (Vector3f), and its irradiance (colour) on a surface that faces it.

        ``p_world`` Point3f (N,), world space. ``inside``: share of the light at the outline (:func:`share_inside`), Float (N,).
        Attached to points, to_world, picture, scale and tangents.
        """
        wo, _ = towards(p_world, self.position)
        local, uv = self._local(p_world)
        inside = share_inside(self, p_world) if inside is None else inside
        lit = mi.Bool(active) & (local.z > 0) & (inside > 0)
        z = dr.select(lit, local.z, 1.0)
        cosine = dr.select(lit, -dr.dot(axis(self.to_world, 2), wo), 1.0)
        weight = picture(self.irradiance, dr.clip(uv, 0, 1), lit) * inside * (dr.pi * self.scale / (dr.square(z) * cosine))
        return wo, dr.select(lit, weight, 0)

    def map_kind(self) -> str:
        return cone_kind(dr.atan(self.spread) * (180 / math.pi))

    def map_views(self, kind: str, resolution: int, filter_size: int) -> tuple[LightView, ...]:
        return cone_views(self.to_world, dr.detach(self.spread), kind, resolution, filter_size)

    def distances(self, p_world: Point3f) -> list[Float]:
        """Distances from the edges that bound the light (Float), positive inside, in units of ``falloff_width``. Attached."""
        _, uv = self._local(p_world)
        return [0.5 - dr.abs(uv[k] - 0.5) for k in range(2)]

    def change(self, p_world: Point3f) -> Float:
        """Upper bound of the change of texture coordinates where points move by one unit. Detached."""
        inverse, (local, uv) = dr.rcp(mi.Matrix3f(dr.detach(self.to_world).matrix)), dr.detach(self._local(p_world))
        scale: Float = mi.Float(dr.sqrt(sum(dr.square(inverse[i, k]) for i in range(3) for k in range(3))))
        slopes = [mi.Float(0.5 / dr.detach(self.tangents[k]) + dr.abs(uv[k] - 0.5)) for k in range(2)]
        steepest: Float = dr.select(slopes[0] > slopes[1], slopes[0], slopes[1])
        before = local.z > 0
        # Twice as much, for points that also come nearer.
        return dr.select(before, 2 * scale * dr.maximum(steepest, 1) / dr.select(before, local.z, 1), dr.inf)

    def _local(self, p_world: Point3f) -> tuple[Vector3f, Point2f]:
        """Points in the projector's own space, and their texture coordinates in the picture."""
        local = dr.rcp(mi.Matrix3f(self.to_world.matrix)) @ mi.Vector3f(p_world - self.position)
        z = dr.select(local.z > 0, local.z, 1.0)
        # As in Mitsuba's cameras, local x points to the left of the picture.
        return local, mi.Point2f(*(0.5 - 0.5 * local[k] / (z * self.tangents[k]) for k in range(2)))


@dataclass(frozen=True)
class Beam(BoundedLight):
    """Parallel light from a rectangle or a disk: Mitsuba's ``directionalarea``.

    Mitsuba's particle tracer shows the beam; its other integrators cannot sample it.

    shape      ``rectangle`` (local -1..1 in x and y) or ``disk`` (local radius 1)
    to_world   Transform4f, of the shape
    radiance   ``mi.Texture`` over the shape; Mitsuba's radiance is here the irradiance on a surface across the beam
    flipped    whether it shines along local -z instead of +z
    falloff_width  Float, world units: width of the rim in which the beam fades, as a projector's picture
    """

    name: str
    shape: str
    to_world: mi.Transform4f
    radiance: mi.Texture
    flipped: bool
    falloff_width: Float

    @property
    def position(self) -> Point3f:
        """Point3f, centre of the shape, world space."""
        return translation(self.to_world)

    @property
    def direction(self) -> Vector3f:
        """Vector3f, unit normal of the shape, the direction in which light travels, world space."""
        # A shape without area has no normal, and lights nothing.
        normal = normalize_or(dr.cross(axis(self.to_world, 0), axis(self.to_world, 1)), mi.Vector3f(0, 0, 1))
        matrix = mi.Matrix3f(self.to_world.matrix)
        # Mitsuba's normals stay on the side of local z where a transform mirrors.
        inwards = dr.detach(dr.det(matrix)) < 0
        return dr.select(inwards ^ self.flipped, -normal, normal)

    @property
    def widest(self) -> Float:
        """Float, world units: upper bound of the rim's width."""
        return dr.detach(self.reach)

    @property
    def reach(self) -> Float:
        """Float, world units: upper bound of the beam's distance from its axis."""
        return dr.norm(axis(self.to_world, 0)) + dr.norm(axis(self.to_world, 1)) + self.falloff_width

    @property
    def caster_start(self) -> Float:
        """Float, world units, detached: least distance of casters from the shape, which must not shadow its own light."""
        place = dr.detach(self.position)
        far = dr.maximum(dr.maximum(dr.abs(place.x), dr.abs(place.y)), dr.abs(place.z))
        return dr.fma(_BEAM_START, dr.detach(self.reach), 1e-5 * far)

    def map_kind(self) -> str:
        return "beam"

    def map_views(self, kind: str, resolution: int, filter_size: int) -> tuple[LightView, ...]:
        view = directional_view(self.direction)
        return (LightView(view.right, view.up, view.forward, mi.Vector3f(self.position), view.spread),)

    def illuminate(self, p_world: Point3f, active: Bool | bool = True, inside: Float | None = None) -> tuple[Vector3f, Color3f]:
        """(wo, weight): unit direction against the beam (Vector3f), and its irradiance (colour) on a surface across it.

        ``p_world`` Point3f (N,), world space. ``inside``: share of the light at the outline (:func:`share_inside`), Float (N,).
        Attached to points, to_world, radiance and rim.
        """
        along, local, _ = self._local(p_world)
        inside = share_inside(self, p_world) if inside is None else inside
        lit = mi.Bool(active) & (along > 0) & (inside > 0)
        if self.shape == "disk":
            angle = dr.atan2(local.y, local.x) * (0.5 / dr.pi)
            uv = mi.Point2f(dr.minimum(dr.norm(local), 1), dr.select(angle < 0, angle + 1, angle))
        else:
            uv = mi.Point2f(*(dr.clip(0.5 + 0.5 * local[k], 0, 1) for k in range(2)))
        return -self.direction, dr.select(lit, picture(self.radiance, uv, lit) * inside, 0)

    def distances(self, p_world: Point3f) -> list[Float]:
        """Distances from the edges that bound the light (Float), positive inside, in units of ``falloff_width``. Attached."""
        _, local, rows = self._local(p_world)
        if self.shape == "disk":
            radius = dr.norm(local)
            return [(1 - radius) * radius / dr.norm(rows[0] * local.x + rows[1] * local.y)]
        return [(1 - dr.abs(local[k])) / dr.norm(rows[k]) for k in range(2)]

    def change(self, p_world: Point3f) -> Float:
        """Upper bound of the change of distances where points move by one unit (none for ellipses). Detached."""
        return mi.Float(dr.inf if self.shape == "disk" else 1)

    def _local(self, p_world: Point3f) -> tuple[Float, Vector2f, list[Vector3f]]:
        """(distance along the beam, place on the shape (Vector2f), derivatives of its two coordinates by the point)."""
        offset = mi.Vector3f(p_world - self.position)
        along = dr.dot(offset, self.direction)
        inverse = dr.rcp(mi.Matrix3f(self.to_world.matrix))
        rows = [mi.Vector3f(inverse[k, 0], inverse[k, 1], inverse[k, 2]) for k in range(2)]
        across = offset - self.direction * along
        local = mi.Vector2f(dr.dot(rows[0], across), dr.dot(rows[1], across))
        if self.shape == "disk":
            # At the centre angle and derivatives are undefined: any other point inside will do.
            local = mi.Vector2f(dr.select(dr.squared_norm(local) == 0, 1e-6, local.x), local.y)
        return along, local, rows


def projector_of(emitter: mi.Emitter, name: str, values: dict[str, Any], picture: mi.Texture) -> Projector:
    """Record of a ``mi.Emitter`` called ``projector``. ``values``: its parameters, ``picture``: its texture."""
    to_world = values["to_world"]
    with dr.suspend_grad():
        # Mitsuba exposes the angles of view only through the projection of points. The distance of the point has no influence.
        place = dr.detach(to_world)
        far = 1 + dr.norm(mi.Vector3f(translation(place)))
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.p = place @ mi.Point3f(0.5 * far, 0.5 * far, far)
        uv = emitter.sample_direction(si, mi.Point2f(0.5))[0].uv
        tangents = mi.Vector2f(0.25 / (0.5 - uv.x), 0.25 / (0.5 - uv.y))
    return Projector(name, to_world, picture, mi.Float(values["scale"]), tangents)


def beam_of(emitter: mi.Emitter, name: str, to_world: mi.Transform4f, radiance: mi.Texture) -> Beam:
    """Record of a ``mi.Emitter`` called ``directionalarea``, which belongs to a rectangle or a disk placed by ``to_world``."""
    shape = emitter.get_shape()
    sides = dr.minimum(*(dr.norm(axis(dr.detach(to_world), k)) for k in range(2)))
    return Beam(name, shape.class_name().lower(), to_world, radiance, shape.has_flipped_normals(), _BEAM_RIM * sides)

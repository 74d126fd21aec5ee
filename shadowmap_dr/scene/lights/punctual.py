"""Lights without extent: directional, point and spot lights."""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ...errors import ShadowmapError
from ...jit.types import Bool, Color3f, Float, Point3f, Vector3f
from ...jit.vectors import unit
from ...shadow.light_camera import LightView, cube_views, directional_view
from ..transforms import axis, translation
from .light import cone_kind, cone_views, covered_angle, picture, towards
from .soft_outline import BoundedLight, share_inside

_DEGREE = math.pi / 180.0


@dataclass(frozen=True)
class DirectionalLight:
    """Parallel light. ``direction``: Vector3f, in which light travels, world space, any length but 0; ``irradiance``: colour."""

    name: str
    direction: Vector3f
    irradiance: Color3f

    def __post_init__(self) -> None:
        # Checks Python numbers and constants only: reading back an evaluated array would wait for the device.
        if dr.is_jit_v(self.direction):
            nowhere = dr.all(self.direction == 0)
            zero = nowhere.state == dr.VarState.Literal and nowhere[0]
        else:
            zero = not any(self.direction)
        if zero:
            raise ShadowmapError(f"light '{self.name}' has the direction (0, 0, 0): give one in which its light travels.")

    def illuminate(self, p_world: Point3f, active: Bool | bool = True) -> tuple[Vector3f, Color3f]:
        """(wo, weight): unit direction to the light (Vector3f) and its irradiance on a surface that faces it."""
        return -unit(mi.Vector3f(self.direction)), self.irradiance & mi.Bool(active)

    def map_kind(self) -> str:
        return "directional"

    def map_views(self, kind: str, resolution: int, filter_size: int) -> tuple[LightView, ...]:
        return (directional_view(mi.Vector3f(self.direction)),)


@dataclass(frozen=True)
class PointLight:
    """Light from a point. ``position``: Point3f, world space; ``intensity``: colour, W/sr."""

    name: str
    position: Point3f
    intensity: Color3f

    def illuminate(self, p_world: Point3f, active: Bool | bool = True) -> tuple[Vector3f, Color3f]:
        """(wo, weight) with weight = intensity / distance^2."""
        wo, inverse_squared = towards(p_world, self.position)
        return wo, (self.intensity * inverse_squared) & mi.Bool(active)

    def map_kind(self) -> str:
        return "cube"

    def map_views(self, kind: str, resolution: int, filter_size: int) -> tuple[LightView, ...]:
        return cube_views(mi.Point3f(self.position), resolution, filter_size)


@dataclass(frozen=True)
class SpotLight(BoundedLight):
    """Cone of light along the local +z axis.

    to_world      Transform4f
    intensity     colour on the axis, W/sr
    cutoff_angle  Float, degrees, half-angle of the cone outside which there is no light
    beam_width    Float, degrees, half-angle up to which intensity is full; in between it falls off linearly in the angle
    texture       ``mi.Texture`` over the square that circumscribes the cone, or None
    """

    name: str
    to_world: mi.Transform4f
    intensity: Color3f
    cutoff_angle: Float
    beam_width: Float
    texture: mi.Texture | None = None

    @property
    def position(self) -> Point3f:
        """Point3f, world space."""
        return translation(self.to_world)

    @property
    def direction(self) -> Vector3f:
        """Vector3f, unit axis of the cone, the direction in which light travels, world space."""
        return dr.normalize(axis(self.to_world, 2))

    @property
    def falloff_width(self) -> Float:
        """Float, radians: width of the rim in which light falls off from full to none. Attached to both angles."""
        return (self.cutoff_angle - self._full) * _DEGREE

    @property
    def widest(self) -> Float:
        """Float, radians: upper bound of the rim's width."""
        return dr.detach(self.cutoff_angle) * _DEGREE

    def illuminate(self, p_world: Point3f, active: Bool | bool = True, inside: Float | None = None) -> tuple[Vector3f, Color3f]:
        """(wo, weight) with weight = intensity * falloff * texture / distance^2.

        ``p_world`` Point3f (N,), world space. ``inside``: the falloff, if known
        (:func:`~shadowmap_dr.scene.lights.soft_outline.share_inside`), Float (N,). Attached to points and all fields.
        """
        wo, inverse_squared = towards(p_world, self.position)
        local = self._local(wo)
        inside = share_inside(self, p_world) if inside is None else inside
        lit = (inside > 0) & mi.Bool(active)
        weight = self.intensity * (inside * inverse_squared)
        if self.texture is not None:
            # Lanes outside the cone may have z = 0. Lanes within a pixel of it lie off the texture, which must not repeat there.
            scale = 0.5 * dr.rcp(dr.select(lit, local.z, 1.0) * dr.tan(self.cutoff_angle * _DEGREE))
            uv = mi.Point2f(0.5 + local.x * scale, 0.5 + local.y * scale)
            weight = weight * picture(self.texture, dr.clip(uv, 0, 1), lit)
        return wo, weight & lit

    def map_kind(self) -> str:
        return cone_kind(self.cutoff_angle)

    def map_views(self, kind: str, resolution: int, filter_size: int) -> tuple[LightView, ...]:
        return cone_views(self.to_world, covered_angle(self.cutoff_angle), kind, resolution, filter_size)

    def distances(self, p_world: Point3f) -> list[Float]:
        """Angle between the middle of the rim and points (Float), positive inside, in radians. Attached."""
        angle = dr.safe_acos(self._local(towards(p_world, self.position)[0]).z)
        return [0.5 * (self.cutoff_angle + self._full) * _DEGREE - angle]

    def change(self, p_world: Point3f) -> Float:
        """Upper bound of the change of the angle, in radians, where points move by one unit. Detached."""
        return dr.sqrt(dr.detach(towards(p_world, self.position)[1]))

    @property
    def _full(self) -> Float:
        """Half-angle in degrees up to which intensity is full, at most that of the cone."""
        return dr.minimum(self.beam_width, self.cutoff_angle)

    def _local(self, wo: Vector3f) -> Vector3f:
        """Unit direction, in the light's own space, of light that arrives from the world-space direction ``wo``."""
        return dr.normalize(mi.Vector3f(dr.rcp(mi.Matrix3f(self.to_world.matrix)) @ mi.Vector3f(-wo)))


@dataclass(frozen=True)
class SquareSpot:
    """A spot light as in Worchel and Alexa's code: full intensity, at any distance, in the square that its shadow map covers."""

    light: SpotLight

    def illuminate(self, p_world: Point3f, active: Bool | bool = True) -> tuple[Vector3f, Color3f]:
        """(wo, weight) with weight = intensity. Outside the square visibility is 0, not the weight."""
        wo, _ = towards(p_world, self.light.position)
        return wo, self.light.intensity & mi.Bool(active)

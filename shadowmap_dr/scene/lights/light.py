"""The protocol of lights without extent, and geometry and pictures that several of them share."""

from __future__ import annotations

import math
from typing import Protocol

import drjit as dr
import mitsuba as mi

from ...jit.gpu import looked_up
from ...jit.types import Bool, Color3f, Float, Point2f, Point3f, Vector3f
from ...shadow.light_camera import LightView, cube_views, spot_view
from ..sums import evaluate

#: Cones with a larger half-angle (degrees) use the faces of a cube.
WIDEST_CONE = 60.0
# Largest half-angle in degrees that one map covers, even if its light has become wider.
_WIDEST_MAP = 80.0


class Illumination(Protocol):
    """Unshadowed light without extent, at points."""

    def illuminate(self, p_world: Point3f, active: Bool | bool = True) -> tuple[Vector3f, Color3f]:
        """(unit direction to the light (Vector3f), irradiance (colour) on a surface that faces it) at points. Attached."""


class LightRecord(Illumination, Protocol):
    """A light without extent: its illumination, and the cameras of its shadow maps. A dataclass whose arrays may be attached.

    ``name``: name by which users refer to it.
    """

    name: str

    def map_kind(self) -> str:
        """Kind of its maps, fixed until a scene is read again: ``directional``, ``beam``, ``spot`` (one map each) or ``cube``
        (six). Read back to the host."""

    def map_views(self, kind: str, resolution: int, filter_size: int) -> tuple[LightView, ...]:
        """Cameras of its maps. ``resolution``: texels along each side of a map; ``filter_size``: of its filter. Attached."""


def cone_kind(half_angle: Float) -> str:
    """``LightRecord.map_kind`` of a cone of light with this half-angle (Float, degrees)."""
    return "spot" if float(dr.max(dr.detach(half_angle))[0]) <= WIDEST_CONE else "cube"


def cone_views(to_world: mi.Transform4f, spread: Float, kind: str, resolution: int, filter_size: int) -> tuple[LightView, ...]:
    """``LightRecord.map_views`` of a cone along the local +z axis. ``spread``: tangent of the half-angle (Float)."""
    matrix = to_world.matrix
    right, up, forward, origin = (mi.Vector3f(matrix[0, k], matrix[1, k], matrix[2, k]) for k in range(4))
    if kind == "cube":
        return cube_views(mi.Point3f(origin), resolution, filter_size)
    return (spot_view(mi.Point3f(origin), dr.normalize(right), dr.normalize(up), dr.normalize(forward), spread),)


def covered_angle(half_angle: Float) -> Float:
    """Tangent (Float) of the half-angle that the map of a cone covers, detached. ``half_angle``: Float, degrees.

    If a light with one map becomes wider than the map, its light outside the map casts no shadows.
    """
    return dr.tan(dr.minimum(dr.detach(half_angle), _WIDEST_MAP) * (math.pi / 180))


def towards(p_world: Point3f, position: Point3f) -> tuple[Vector3f, Float]:
    """Unit vector from p_world to a position, and 1 / distance^2."""
    offset = mi.Vector3f(position - p_world)
    inverse_squared = dr.rcp(dr.squared_norm(offset))
    return offset * dr.sqrt(inverse_squared), inverse_squared


def picture(texture: mi.Texture, uv: Point2f, active: Bool | bool) -> Color3f:
    """Colour of a texture at texture coordinates (Point2f). Attached to both."""
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(uv))
    si.uv = uv

    def colour(at: tuple[mi.SurfaceInteraction3f, Bool]) -> Color3f:
        return looked_up(lambda *where: mi.UnpolarizedSpectrum(texture.eval(*where)), *at)

    return evaluate(colour, (si, mi.Bool(active)), [texture], dr.width(uv))

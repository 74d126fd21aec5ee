"""The protocol of lights without extent, and geometry and pictures that several of them share."""

from __future__ import annotations

import math
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi

from ...jit.gpu import looked_up
from ...shadow.light_camera import LightView, cube_views, spot_view
from ..sums import evaluate

#: Cones with a larger half-angle (degrees) use the faces of a cube.
WIDEST_CONE = 60.0
# Half-angle in degrees that one map covers, whatever becomes of its light.
_WIDEST_MAP = 80.0


class LightRecord(Protocol):
    """A light without extent: how it illuminates, and the cameras of its shadow maps. A dataclass whose arrays may be attached.

    ``name``: by which users refer to it.
    """

    name: str

    def illuminate(self, p_world: Any, active: Any = True) -> tuple[Any, Any]:
        """(unit direction to the light (Vector3f), irradiance (colour) on a surface that faces it) at points. Attached."""

    def map_kind(self) -> str:
        """Kind of its maps, for as long as a scene is not read again: ``directional``, ``beam``, ``spot`` (one map each) or
        ``cube`` (six). Read back to the host."""

    def map_views(self, kind: str, resolution: int, filter_size: int) -> tuple[LightView, ...]:
        """Cameras of its maps, which have so many texels along a side, and a filter of so many. Attached."""


def cone_kind(half_angle: Any) -> str:
    """``LightRecord.map_kind`` of a cone of light with this half-angle (Float, degrees)."""
    return "spot" if float(dr.max(dr.detach(half_angle))[0]) <= WIDEST_CONE else "cube"


def cone_views(to_world: Any, spread: Any, kind: str, resolution: int, filter_size: int) -> tuple[LightView, ...]:
    """``LightRecord.map_views`` of a cone along the local +z axis. ``spread``: tangent of the half-angle (Float)."""
    matrix = to_world.matrix
    right, up, forward, origin = (mi.Vector3f(matrix[0, k], matrix[1, k], matrix[2, k]) for k in range(4))
    if kind == "cube":
        return cube_views(mi.Point3f(origin), resolution, filter_size)
    return (spot_view(mi.Point3f(origin), *(dr.normalize(axis) for axis in (right, up, forward)), spread),)


def covered_angle(half_angle: Any) -> Any:
    """Tangent (Float) of the half-angle that the map of a cone covers, detached. ``half_angle``: Float, degrees.

    A light of one map that has become wider since is lit beyond it.
    """
    return dr.tan(dr.minimum(dr.detach(half_angle), _WIDEST_MAP) * (math.pi / 180))


def towards(p_world: Any, position: Any) -> tuple[Any, Any]:
    """Unit vector from p_world to a position, and 1 / distance^2."""
    offset = mi.Vector3f(position - p_world)
    inverse_squared = dr.rcp(dr.squared_norm(offset))
    return offset * dr.sqrt(inverse_squared), inverse_squared


def picture(texture: Any, uv: Any, active: Any) -> Any:
    """Colour of a texture at texture coordinates (Point2f). Attached to both."""
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(uv))
    si.uv = uv

    def colour(at: tuple[Any, Any]) -> Any:
        return looked_up(lambda *where: mi.UnpolarizedSpectrum(texture.eval(*where)), *at)

    return evaluate(colour, (si, mi.Bool(active)), [texture], dr.width(uv))

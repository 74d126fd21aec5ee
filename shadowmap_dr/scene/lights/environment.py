"""Environments, which shine from infinitely far away in all directions, and the sun of a sky."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import lru_cache

import drjit as dr
import mitsuba as mi

from ...errors import ShadowmapError
from ...jit.gpu import looked_up
from ...jit.types import Bool, Color3f, Vector3f
from ..mitsuba_objects import parameters

SUNSKY = "SunskyEmitter"
ENVIRONMENTS = ("ConstantBackgroundEmitter", "EnvironmentMapEmitter", SUNSKY)

# A physical sky is smooth without its sun.
_SUNSKY_ROWS = 128
# Directions within this many of the sun's radii count as the sun: rounding must not leave a rim of it in the sky.
_RIM = 1.05


@dataclass(frozen=True)
class Environment:
    """Mitsuba's ``constant`` or ``envmap`` emitter."""

    name: str
    emitter: mi.Emitter

    @property
    def nodes(self) -> list[mi.Object]:
        """Objects of Mitsuba's that determine its radiance."""
        return [self.emitter]

    @property
    def rows(self) -> int:
        """Rows of its image, 0 if it has none."""
        data = parameters(self.emitter).get("data")
        return 0 if data is None else int(data.shape[0])

    def to_world(self, direction: Vector3f) -> Vector3f:
        """World-space direction (Vector3f) of a direction in the environment's own space, in which y points to the zenith.

        Attached to the environment's rotation.
        """
        to_world = parameters(self.emitter).get("to_world")
        return direction if to_world is None else mi.Vector3f(mi.Matrix3f(to_world.matrix) @ direction)

    def radiance(self, direction: Vector3f, active: Bool | bool = True) -> Color3f:
        """Radiance (colour) that arrives *from* the unit world-space ``direction`` (Vector3f). Attached to the emitter."""
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(direction))
        si.wi = -direction
        return looked_up(self.emitter.eval, si, mi.Bool(active))

    def diffuse_radiance(self, direction: Vector3f) -> Color3f:
        """Radiance without the sun, which is a light of its own. Samples of the environment have this radiance."""
        return self.radiance(direction)


@dataclass(frozen=True)
class SunSky(Environment):
    """Mitsuba's ``sunsky``. Its sun, too small and bright to be a sample of the sky, is a light of its own: :meth:`sun`."""

    @property
    def rows(self) -> int:
        """Rows of a grid that is fine enough for the sky without the sun."""
        return _SUNSKY_ROWS

    def to_world(self, direction: Vector3f) -> Vector3f:
        """World-space direction, as for other environments: y points to the zenith, although to +z in the emitter itself."""
        turned = mi.Vector3f(direction.x, -direction.z, direction.y)
        return Environment.to_world(self, turned)

    def diffuse_radiance(self, direction: Vector3f) -> Color3f:
        """Radiance of the sky without the sun. The sun's disc takes the radiance of the sky at its rim."""
        sun = dr.detach(self._towards_sun())
        radius = _RIM * _sun_radius(self.emitter)
        along = dr.dot(direction, sun)
        across = direction - sun * along
        length = dr.norm(across)
        across = dr.select(length > 1e-6, across / dr.maximum(length, 1e-6), mi.coordinate_system(sun)[0])
        rim = sun * math.cos(radius) + across * math.sin(radius)
        return self.radiance(dr.select(along > math.cos(radius), rim, direction))

    def sun(self) -> tuple[Vector3f, Color3f]:
        """(direction in which sunlight travels, unit, world space; irradiance of a surface that faces the sun).

        Attached to the sun's direction and to all parameters of its radiance. The disc has one radiance, and counts as a whole
        even if the horizon cuts it.
        """
        towards = self._towards_sun()
        disc = self.radiance(towards) - self.diffuse_radiance(dr.detach(towards))
        return -towards, disc * (2 * math.pi * (1 - math.cos(_sun_radius(self.emitter))))

    def _towards_sun(self) -> Vector3f:
        return dr.normalize(mi.Vector3f(parameters(self.emitter)["sun_direction"]))


@dataclass(frozen=True)
class UniformRadiance:
    """Constant radiance from all directions, beside the scene's own environment."""

    value: float

    def radiance(self, direction: Vector3f, active: Bool | bool = True) -> Color3f:
        return dr.select(active, mi.UnpolarizedSpectrum(self.value), 0)


def environment_of(emitter: mi.Emitter, name: str) -> Environment:
    """Record of a ``mi.Emitter`` that is one of ``ENVIRONMENTS``."""
    return (SunSky if emitter.class_name() == SUNSKY else Environment)(name, emitter)


@lru_cache(maxsize=16)
def _sun_radius(emitter: mi.Emitter) -> float:
    """Half the angle that a sun covers, in radians. No parameter holds it; it is parsed from the emitter's ``str``.

    Cached, since the angle never changes and ``str`` reads numbers back from the device.
    """
    found = re.search(r"Sun aperture = ([-+.\deE]+)", str(emitter))
    if found is None:
        raise ShadowmapError(f"emitter '{emitter.id()}' does not tell its sun_aperture: use another Mitsuba, or envmap.")
    return math.radians(float(found.group(1)) / 2)

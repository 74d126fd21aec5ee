"""Light from infinitely far away, from all directions, and the sun that stands in a sky."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi

from ...errors import ShadowmapError
from ...jit.gpu import looked_up
from ..mitsuba_objects import parameters

SUNSKY = "SunskyEmitter"
ENVIRONMENTS = ("ConstantBackgroundEmitter", "EnvironmentMapEmitter", SUNSKY)

# A physical sky is smooth once the sun is left out.
_SUNSKY_ROWS = 128
# What lies within this many of the sun's radii counts as the sun: rounding must not leave a rim of it in the sky.
_RIM = 1.05


@dataclass(frozen=True)
class Environment:
    """Mitsuba's ``constant`` or ``envmap`` emitter."""

    name: str
    emitter: Any

    @property
    def nodes(self) -> list[Any]:
        """Objects of Mitsuba's that its radiance comes from."""
        return [self.emitter]

    @property
    def rows(self) -> int:
        """Rows of its image, 0 if it has none."""
        data = parameters(self.emitter).get("data")
        return 0 if data is None else int(data.shape[0])

    def to_world(self, direction: Any) -> Any:
        """World-space direction (Vector3f) of one in the environment's own space, in which y points to the zenith.

        Attached to its rotation.
        """
        to_world = parameters(self.emitter).get("to_world")
        return direction if to_world is None else mi.Vector3f(mi.Matrix3f(to_world.matrix) @ direction)

    def radiance(self, direction: Any, active: Any = True) -> Any:
        """Radiance (colour) that arrives *from* the unit world-space ``direction`` (Vector3f). Attached to the emitter."""
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(direction))
        si.wi = -direction
        return looked_up(self.emitter.eval, si, mi.Bool(active))

    def diffuse_radiance(self, direction: Any) -> Any:
        """The same without what is a light of its own: what samples of the environment stand for."""
        return self.radiance(direction)


@dataclass(frozen=True)
class SunSky(Environment):
    """Mitsuba's ``sunsky``. Its sun is too small and too bright to be one sample among others: see :meth:`sun`."""

    @property
    def rows(self) -> int:
        """Rows of a grid that is fine enough to measure the sky without the sun."""
        return _SUNSKY_ROWS

    def to_world(self, direction: Any) -> Any:
        """As for other environments; the emitter itself has the zenith at +z."""
        turned = mi.Vector3f(direction.x, -direction.z, direction.y)
        return Environment.to_world(self, turned)

    def diffuse_radiance(self, direction: Any) -> Any:
        """Radiance of the sky without the sun, in whose place is what surrounds it."""
        sun = dr.detach(self._towards_sun())
        radius = _RIM * _sun_radius(self.emitter)
        along = dr.dot(direction, sun)
        across = direction - sun * along
        length = dr.norm(across)
        across = dr.select(length > 1e-6, across / dr.maximum(length, 1e-6), mi.coordinate_system(sun)[0])
        rim = sun * math.cos(radius) + across * math.sin(radius)
        return self.radiance(dr.select(along > math.cos(radius), rim, direction))

    def sun(self) -> tuple[Any, Any]:
        """(direction in which its light travels, unit, world space; irradiance of a surface that faces it).

        Attached to the sun's direction and to all that its radiance depends on. The disc is of one radiance; what of it is below
        the horizon when its centre is above is not left out.
        """
        towards = self._towards_sun()
        disc = self.radiance(towards) - self.diffuse_radiance(dr.detach(towards))
        return -towards, disc * (2 * math.pi * (1 - math.cos(_sun_radius(self.emitter))))

    def _towards_sun(self) -> Any:
        return dr.normalize(mi.Vector3f(parameters(self.emitter)["sun_direction"]))


@dataclass(frozen=True)
class UniformRadiance:
    """Constant radiance from all directions, beside the scene's own environment."""

    value: float

    def radiance(self, direction: Any, active: Any = True) -> Any:
        return dr.select(active, mi.UnpolarizedSpectrum(self.value), 0)


def environment_of(emitter: Any, name: str) -> Environment:
    """Record of a ``mi.Emitter`` that is one of ``ENVIRONMENTS``."""
    return (SunSky if emitter.class_name() == SUNSKY else Environment)(name, emitter)


@lru_cache(maxsize=16)
def _sun_radius(emitter: Any) -> float:
    """Half the angle that a sun covers, in radians. It is no parameter, but part of what an emitter says about itself.

    Kept, since to ask reads numbers back: the angle never changes.
    """
    found = re.search(r"Sun aperture = ([-+.\deE]+)", str(emitter))
    if found is None:
        raise ShadowmapError(f"emitter '{emitter.id()}' does not tell its sun_aperture: use another Mitsuba, or envmap.")
    return math.radians(float(found.group(1)) / 2)

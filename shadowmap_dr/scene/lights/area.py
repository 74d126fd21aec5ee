"""Area lights: shapes that shine."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ...jit.gpu import looked_up
from ...jit.types import Bool, Color3f, Float, Point2f


@dataclass(frozen=True)
class AreaLight:
    """A shape that shines from its outer side.

    ``shape``: its index in the soup; ``emitter``: Mitsuba's ``area``; ``textured``: whether its radiance varies over the shape
    (static); ``scale``: factor of radiance.
    """

    name: str
    shape: int
    emitter: mi.Emitter
    textured: bool = False
    scale: Float | float = 1.0

    def radiance(self, uv: Point2f) -> Color3f:
        """Radiance (colour) at points with texture coordinates ``uv`` (Point2f). Attached to the emitter."""
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(uv))
        si.uv = uv
        si.wi = mi.Vector3f(0, 0, 1)
        return self.seen(si, mi.Bool(True))

    def seen(self, si: mi.SurfaceInteraction3f, active: Bool) -> Color3f:
        """Radiance (colour) of surface points towards ``si.wi``."""
        return looked_up(lambda *where: mi.UnpolarizedSpectrum(self.emitter.eval(*where)), si, active) * self.scale

"""Area lights: shapes that shine."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ...jit.gpu import looked_up


@dataclass(frozen=True)
class AreaLight:
    """A shape that shines from its outer side.

    ``shape``: its index; ``emitter``: Mitsuba's ``area``; ``textured``: whether its radiance varies over the shape (static);
    ``scale``: factor of radiance.
    """

    name: str
    shape: int
    emitter: Any
    textured: bool = False
    scale: Any = 1.0

    def radiance(self, uv: Any) -> Any:
        """Radiance (colour) of points with these texture coordinates (Point2f). Attached to the emitter."""
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(uv))
        si.uv = uv
        si.wi = mi.Vector3f(0, 0, 1)
        return self.seen(si, mi.Bool(True))

    def seen(self, si: Any, active: Any) -> Any:
        """Radiance (colour) of surface points towards ``si.wi``."""
        return looked_up(lambda *where: mi.UnpolarizedSpectrum(self.emitter.eval(*where)), si, active) * self.scale

"""Geometry and pictures that several lights share."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ...jit.gpu import looked_up
from ..sums import evaluate


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

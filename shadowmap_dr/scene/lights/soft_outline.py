"""Lights with an outline, at which they fade over the width of a pixel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ...jit.broadcast import broadcast_differentiable

# Of a rim without any width, in units of the rim: it is divided by.
_NARROWEST = 1e-7


class BoundedLight:
    """A light with an outline at which it fades: projectors, beams, spot lights.

    falloff_width  width of the rim in which it fades, half of it on either side of the outline (Float, or number)
    widest  the rim is never made wider than this (detached)
    """

    falloff_width: Any
    widest: Any

    def illuminate(self, p_world: Any, active: Any = True, inside: Any = None) -> tuple[Any, Any]:
        """(wo, weight), as of all lights; ``inside``: what :func:`share_inside` returns, if known."""
        raise NotImplementedError

    def distances(self, p_world: Any) -> list[Any]:
        """Distances from the edges that bound the light (Float), positive inside, in units of ``falloff_width``. Attached."""
        raise NotImplementedError


@dataclass(frozen=True)
class Softened:
    """A light with an outline on a surface, where the share of its light that is let through is known: Float (N,)."""

    light: BoundedLight
    inside: Any

    def illuminate(self, p_world: Any, active: Any = True) -> tuple[Any, Any]:
        """As the light's."""
        return self.light.illuminate(p_world, active, self.inside)


def softened(lights: Sequence[Any], p_world: Any, footprints: Callable[[], Sequence[Any]]) -> tuple[Any, ...]:
    """The same lights; the outlines of those that have one are at least as soft as pixels are wide.

    ``p_world`` Point3f (N,); ``footprints`` gives points half way to the corners of each pixel (Point3f (N,) each), and is called
    only where there are such lights. One sample per pixel is enough then for derivatives of moving outlines.
    """
    if not any(isinstance(light, BoundedLight) for light in lights):
        return tuple(lights)
    around, width = footprints(), dr.width(p_world)
    wide = (broadcast_differentiable(light, width) if isinstance(light, BoundedLight) else light for light in lights)
    return tuple(
        Softened(light, share_inside(light, p_world, around)) if isinstance(light, BoundedLight) else light for light in wide
    )


def share_inside(light: BoundedLight, p_world: Any, around: Sequence[Any] = ()) -> Any:
    """Share of the light (Float, N) that the outline lets through: 1 inside, 0 outside, a ramp in between. Attached.

    ``around``: points half way to the corners of the pixel around each of ``p_world``; the ramp is as wide as the pixel, or else
    as the rim.
    """
    distances = light.distances(p_world)
    with dr.suspend_grad():
        widths = [mi.Float(_NARROWEST) for _ in distances]
        for other in around:
            for k, (here, there) in enumerate(zip(distances, light.distances(other), strict=True)):
                widths[k] = dr.maximum(widths[k], dr.minimum(4 * dr.abs(dr.detach(there) - dr.detach(here)), light.widest))
    share = mi.Float(1)
    for distance, width in zip(distances, widths, strict=True):
        share *= dr.clip(0.5 + distance / dr.maximum(width, light.falloff_width), 0, 1)
    return share

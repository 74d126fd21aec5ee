"""Lights with an outline, at which they fade over the width of a pixel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ...jit.branches import branch
from ...jit.broadcast import broadcast_differentiable
from ...jit.types import Bool, Color3f, Float, Point3f, Vector3f
from .light import Illumination

# Least width of a rim, in units of ``falloff_width``, since it is divided by.
_NARROWEST = 1e-7
# Change of distances over a pixel from which on its bound says little, and largest width of a ramp, in units of the bound.
_LARGE, _ROOM = 0.5, 5.0


class BoundedLight:
    """A light with an outline at which it fades: projectors, beams, spot lights.

    falloff_width  width of the rim in which it fades, half of it on either side of the outline (Float, or number)
    widest  upper bound of the rim's width (detached)
    """

    falloff_width: Any  # Any: a field or a read-only property, an array or a number
    widest: Any  # Any: as ``falloff_width``

    def illuminate(self, p_world: Point3f, active: Bool | bool = True, inside: Float | None = None) -> tuple[Vector3f, Color3f]:
        """(wo, weight), as for all lights; ``inside``: result of :func:`share_inside`, if known."""
        raise NotImplementedError

    def distances(self, p_world: Point3f) -> list[Float]:
        """Distances from the edges that bound the light (Float), positive inside, in units of ``falloff_width``. Attached."""
        raise NotImplementedError

    def change(self, p_world: Point3f) -> Float:
        """Upper bound of the change of :meth:`distances` where points move by one unit of the world. Detached."""
        raise NotImplementedError


@dataclass(frozen=True)
class Softened:
    """A light with an outline, and the share of its light that the outline lets through at surface points: Float (N,)."""

    light: BoundedLight
    inside: Float

    def illuminate(self, p_world: Point3f, active: Bool | bool = True) -> tuple[Vector3f, Color3f]:
        """(wo, weight) of the light with this share."""
        return self.light.illuminate(p_world, active, self.inside)


@dataclass(frozen=True)
class Footprints:
    """Points around those that pixels see, half way to the pixels' corners. Detached.

    lanes   arrays (N,) from which the points follow
    points  ``points(p_world, *lanes)``, points (Point3f) around those of some pixels
    reach   Float (N,), upper bound of their distance
    """

    lanes: tuple[Any, ...]
    points: Callable[..., Sequence[Point3f]]
    reach: Float


def softened(lights: Sequence[Illumination], p_world: Point3f, footprints: Callable[[], Footprints]) -> tuple[Illumination, ...]:
    """The same lights, but with outlines at least as soft as pixels are wide.

    ``p_world`` Point3f (N,); ``footprints``: called only if a light has an outline. One sample per pixel is then enough for
    derivatives of moving outlines.
    """
    if not any(isinstance(light, BoundedLight) for light in lights):
        return tuple(lights)
    around, width = footprints(), dr.width(p_world)
    wide = (broadcast_differentiable(light, width) if isinstance(light, BoundedLight) else light for light in lights)
    return tuple(
        Softened(light, share_inside(light, p_world, around)) if isinstance(light, BoundedLight) else light for light in wide
    )


def share_inside(light: BoundedLight, p_world: Point3f, around: Footprints | Sequence[Point3f] = ()) -> Float:
    """Share of the light (Float, N) that the outline lets through: 1 inside, 0 outside, a ramp in between. Attached.

    ``around``: points half way to the corners of the pixel around each of ``p_world``. The ramp is as wide as the pixel, and at
    least as wide as the rim.
    """
    distances = light.distances(p_world)
    if isinstance(around, Footprints):
        widths = _widths_beside(light, p_world, distances, around)
    else:
        widths = _widths(light, distances, around)
    share = mi.Float(1)
    for distance, width in zip(distances, widths, strict=True):
        share *= dr.clip(0.5 + distance / dr.maximum(width, light.falloff_width), 0, 1)
    return share


def _widths(light: BoundedLight, distances: list[Float], around: Sequence[Point3f]) -> list[Float]:
    """Width of the ramp at each edge: the change of the distances over a pixel. Detached."""
    with dr.suspend_grad():
        widths = [mi.Float(_NARROWEST) for _ in distances]
        for other in around:
            for k, (here, there) in enumerate(zip(distances, light.distances(other), strict=True)):
                widths[k] = dr.maximum(widths[k], dr.minimum(4 * dr.abs(dr.detach(there) - dr.detach(here)), light.widest))
        return widths


def _widths_beside(light: BoundedLight, p_world: Point3f, distances: list[Float], around: Footprints) -> list[Float]:
    """As :func:`_widths`, beside the outline. Elsewhere ramps are as narrow as can be: few pixels see the outline."""
    with dr.suspend_grad():
        p_world = dr.detach(p_world)
        change = around.reach * light.change(p_world)
        beside = change > _LARGE
        for distance in distances:
            beside |= dr.abs(dr.detach(distance)) < 0.5 * dr.maximum(light.falloff_width, _ROOM * change)

        def look(p_world: Point3f, *lanes: Any) -> tuple[Float, ...]:  # Any: lanes of any type
            return tuple(_widths(light, light.distances(p_world), around.points(p_world, *lanes)))

        def narrow(p_world: Point3f, *lanes: Any) -> tuple[Float, ...]:  # Any: as above
            return tuple(mi.Float(_NARROWEST) for _ in distances)

        return list(branch(beside, look, narrow, (p_world, *around.lanes), "outline of a light"))

"""Axes of directional lights' maps whose derivatives leave visible surfaces where they are.

When a light turns about the world's origin, far surfaces and their casters move through its map together. Shadows move by the
small difference. Derivatives of maps and of look-ups are sums of both motions, and their errors grow with them. The coordinates
of a map may be chosen freely, as long as points on a ray of light share them. Here the axes change with the light so that the
plane that fits the visible points best does not move, and depths are measured along the light's detached direction. Coordinates
and depths have the same values as before.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr

from ..jit.arrays import backend, replace_grad
from ..jit.kernel_inputs import split
from ..jit.types import Bool, Float, Point3f, Vector3f
from .light_camera import Frusta, Views, of_map, to_light_space
from .nearest_planes import nearest_planes


def steady_axes(views: Views, frusta: Frusta, seen: tuple[Point3f, Bool]) -> Views:
    """Views with the same values, attached so that visible surfaces hardly move when a light turns. Perspective views stay.

    Args:
        views: cameras of the M maps; ``forward`` is the light's direction, before :func:`with_depths_from_planes`.
        frusta: what the maps cover; only visible points inside count.
        seen: (points in world space, spread over the visible receivers; mask of valid points).
    """
    module = backend(views.spread)
    still = dr.detach(views)
    slope_x, slope_y, height = _planes(still, frusta, seen)
    parallel = still.spread == 0
    # A normal of the plane, which has a product of one with the light's direction.
    normal = still.forward - slope_x * still.right - slope_y * still.up
    across = dr.dot(normal, views.forward)

    def axis(own: Vector3f, old: Vector3f) -> Vector3f:
        moved = own - normal * (dr.dot(own, views.forward) / across)
        return module.Array3f(*(dr.select(parallel, replace_grad(own[c], moved[c]), old[c]) for c in range(3)))

    forward = [dr.select(parallel, still.forward[c], views.forward[c]) for c in range(3)]
    pivot = [replace_grad(still.origin[c], -height * views.forward[c]) for c in range(3)]
    origin = [dr.select(parallel, pivot[c], views.origin[c]) for c in range(3)]
    return replace(
        views,
        right=axis(still.right, views.right),
        up=axis(still.up, views.up),
        forward=module.Array3f(*forward),
        origin=module.Array3f(*origin),
    )


def _planes(views: Views, frusta: Frusta, seen: tuple[Point3f, Bool]) -> tuple[Float, Float, Float]:
    """(a, b, c) of the planes z = a x + b y + c, in light space, that are nearest to the visible points of each map. Detached."""
    module, count = backend(views.spread), views.count
    with dr.suspend_grad():
        number = dr.width(seen[0])
        lane = dr.arange(module.UInt32, count * number)
        which, source = split(lane, "points", number, count)
        point = module.Array3f(*(dr.gather(module.Float, seen[0][c], source) for c in range(3)))
        p = to_light_space(of_map(views, which, count), point)
        active = dr.gather(module.Bool, module.Bool(seen[1]), source)
        window = of_map(frusta, which, count)
        active &= (dr.abs(p.x - window.center_x) <= window.half_x) & (dr.abs(p.y - window.center_y) <= window.half_y)
        return nearest_planes((p.x, p.y, p.z), which, count, active)

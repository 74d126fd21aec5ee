"""Triangle meshes of tubes: circles about points of a curve, joined from one to the next. Differentiable in the circles.

No circle is turned about the curve against the one before (a rotation-minimising frame), so tubes never twist, whichever way a
curve goes. Texture coordinates follow Mitsuba nevertheless, whose u = 0 lies where the world's z axis decides.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...jit.arrays import device_array
from ...jit.vectors import normalize_or

# Least part of a normal that points away from the curve, relative to a straight tube's: where a curve bends more than its tube
# allows, the tube's inner side is folded, and normals would change sides.
_LEAST_UPRIGHT = 0.02


@dataclass(frozen=True)
class Layout:
    """Layout of tubes, which stays the same when their circles move: R circles with N corners each, of one curve after the other.

    corners    N
    previous   UInt32 (R,)  the circle before; the first of a curve has itself
    first      UInt32 (R,)  the first circle of the same curve
    v          Float  (R,)  second texture coordinate
    shift      Float  (R,)  what is added to the number of a corner in its first texture coordinate: 0.5 where the circle is a
                            point, which has one corner for each triangle that ends there
    directions Float  (2N,) cosine and sine of each corner's angle
    """

    corners: int
    previous: Any
    first: Any
    v: Any
    shift: Any
    directions: Any

    @classmethod
    def of(cls, corners: int, first: np.ndarray, v: np.ndarray, points: np.ndarray) -> Layout:
        """From arrays of the circles: ``first`` and ``v`` as above, ``points``: which circles are points, bool (R,)."""
        number = np.arange(len(first))
        angle = 2 * np.pi * np.arange(corners) / corners
        return cls(
            corners=corners,
            previous=device_array(mi.UInt32, np.maximum(number - 1, first)),
            first=device_array(mi.UInt32, first),
            v=device_array(mi.Float, v),
            shift=device_array(mi.Float, np.where(points, 0.5, 0)),
            directions=device_array(mi.Float, np.stack([np.cos(angle), np.sin(angle)], -1)),
        )

    def faces(self) -> np.ndarray:
        """Vertex indices, uint32 (F, 3), counter-clockwise seen from outside. Each circle has N + 1 vertices."""
        first, points = self.first.numpy().astype(np.int64), self.shift.numpy() > 0
        joined = np.flatnonzero(first[1:] == first[:-1])  # each with the next one
        row, corner = (a.ravel() for a in np.meshgrid(joined, np.arange(self.corners), indexing="ij"))
        here = row * (self.corners + 1) + corner
        there = here + self.corners + 1
        triangles = [(~points[row], [here, here + 1, there + 1]), (~points[row + 1], [here, there + 1, there])]
        return np.concatenate([np.stack(three, -1)[kept] for kept, three in triangles]).astype(np.uint32)


@dataclass(frozen=True)
class Circles:
    """Places of the circles, R of them; world space. May carry gradients.

    centre   Point3f   points of the curve
    tangent  Vector3f  unit direction of the curve
    across, along      Float, distances of the circle's points from the centre: across the tangent, along it
    upright, lean      Float, the normal's parts in the same directions
    bend     Vector3f  curvature vector times radius: normals stand less upright on its side
    """

    centre: Any
    tangent: Any
    across: Any
    along: Any
    upright: Any
    lean: Any
    bend: Any


def tube_mesh(layout: Layout, circles: Circles) -> tuple[Any, Any, Any]:
    """(positions (3V,), unit normals (3V,), texture coordinates (2V,)), flat Float, V = R (N + 1), attached to the circles.

    Where the first texture coordinate would jump along a curve it goes on beyond 0 to 1; repeated textures do not show it.
    """
    count = layout.corners + 1
    lane = dr.arange(mi.UInt32, dr.width(layout.v) * count)
    ring = lane // count
    corner = lane - ring * count
    first, second, turns = _frames(layout, circles.tangent)
    # The last corner is the first again, to the last bit: otherwise the tube would be open there.
    direction = dr.gather(mi.Vector2f, layout.directions, dr.select(corner == layout.corners, 0, corner))
    outward = dr.gather(mi.Vector3f, first, ring) * direction.x + dr.gather(mi.Vector3f, second, ring) * direction.y
    tangent = dr.gather(mi.Vector3f, dr.ravel(circles.tangent), ring)
    value = {name: dr.gather(mi.Float, getattr(circles, name), ring) for name in ("across", "along", "upright", "lean")}
    position = dr.gather(mi.Vector3f, dr.ravel(circles.centre), ring) + outward * value["across"] + tangent * value["along"]
    bend = dr.dot(outward, dr.gather(mi.Vector3f, dr.ravel(circles.bend), ring))
    normal = dr.normalize(outward * (value["upright"] * dr.maximum(1 - bend, _LEAST_UPRIGHT)) + tangent * value["lean"])
    u = (mi.Float(corner) + dr.gather(mi.Float, layout.shift, ring)) / layout.corners + dr.gather(mi.Float, turns, ring)
    return dr.ravel(position), dr.ravel(normal), dr.ravel(mi.Point2f(u, dr.gather(mi.Float, layout.v, ring)))


def _frames(layout: Layout, tangent: Any) -> tuple[Any, Any, Any]:
    """Points where circles start, and a quarter of them further on (Float (3R,) each), and u of their start.

    The choice of the start is detached; gradients keep the circles across the curve, and u as Mitsuba has it.
    """
    with dr.suspend_grad():
        t = dr.detach(tangent)
        zero, quarter = _frame_of_u(t)
        before, carried = (dr.gather(mi.Vector3f, dr.ravel(value), layout.previous) for value in (t, zero))
        # The smallest rotation between the two tangents.
        carried -= (before + t) * (dr.dot(t, carried) / dr.maximum(1 + dr.dot(before, t), 1e-6))
        angle = dr.cumsum(dr.atan2(dr.dot(carried, quarter), dr.dot(carried, zero)))
        angle -= dr.gather(mi.Float, angle, layout.first)
        sine, cosine = dr.sincos(angle)
        start = zero * cosine + quarter * sine
    first = dr.normalize(start - tangent * dr.dot(tangent, start))
    zero, quarter = _frame_of_u(tangent)
    turns = dr.replace_grad(angle, dr.atan2(dr.dot(first, quarter), dr.dot(first, zero))) * dr.inv_two_pi
    return dr.ravel(first), dr.ravel(dr.cross(tangent, first)), turns


def _frame_of_u(tangent: Any) -> tuple[Any, Any]:
    """Unit vectors to u = 0 and u = 1/4 of Mitsuba's curves: the latter leans to z; where the tangent is z itself, to y."""
    lean = mi.Vector3f(0, 0, 1) - tangent * tangent.z
    singular = dr.squared_norm(lean) < 1e-10
    other = mi.Vector3f(0, 1, 0) - tangent * tangent.y
    quarter = normalize_or(dr.select(singular, other, lean), mi.Vector3f(0, 1, 0))
    return dr.cross(quarter, tangent), quarter

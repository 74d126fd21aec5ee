"""Triangle meshes of tubes: circles about points of a curve, each joined to the next. Differentiable in the circles.

The circles follow a rotation-minimising frame, so tubes never twist. Texture coordinates follow Mitsuba nevertheless, where the
world's z axis decides on the place of u = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...jit.arrays import device_array, ravel, replace_grad
from ...jit.types import Float, Point3f, UInt32, Vector3f
from ...jit.vectors import normalize_or

# Lower bound of a normal's component away from the curve, relative to a straight tube's. Where a curve bends more than the tube's
# radius allows, the inner side of the tube is folded, and normals would change sides.
_LEAST_UPRIGHT = 0.02


@dataclass(frozen=True)
class Layout:
    """Layout of tubes, independent of the circles' places: R circles with N corners each, curve by curve.

    corners    N
    previous   UInt32 (R,)  the previous circle; for the first circle of a curve itself
    first      UInt32 (R,)  the first circle of the same curve
    v          Float  (R,)  second texture coordinate
    shift      Float  (R,)  offset of a corner's number in the first texture coordinate: 0.5 where the circle is a point, which
                            has one corner for each triangle that ends there
    directions Float  (2N,) cosine and sine of each corner's angle
    """

    corners: int
    previous: UInt32
    first: UInt32
    v: Float
    shift: Float
    directions: Float

    @classmethod
    def of(cls, corners: int, first: np.ndarray, v: np.ndarray, points: np.ndarray) -> Layout:
        """Layout from arrays of the circles: ``first`` and ``v`` as above, ``points``: True for circles that are points, (R,)."""
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
    upright, lean      Float, the normal's components in the same directions
    bend     Vector3f  curvature vector times radius: on its side normals stand less upright
    """

    centre: Point3f
    tangent: Vector3f
    across: Float
    along: Float
    upright: Float
    lean: Float
    bend: Vector3f


def tube_mesh(layout: Layout, circles: Circles) -> tuple[Float, Float, Float]:
    """(positions (3V,), unit normals (3V,), texture coordinates (2V,)), flat Float, V = R (N + 1), attached to the circles.

    Instead of jumping along a curve, the first texture coordinate continues beyond 0 to 1; textures that repeat do not show it.
    """
    count = layout.corners + 1
    lane = dr.arange(mi.UInt32, dr.width(layout.v) * count)
    ring = lane // count
    corner = lane - ring * count
    first, second, turns = _frames(layout, circles.tangent)
    # The last corner equals the first to the last bit: otherwise the tube would be open there.
    direction = dr.gather(mi.Vector2f, layout.directions, dr.select(corner == layout.corners, 0, corner))
    outward = dr.gather(mi.Vector3f, first, ring) * direction.x + dr.gather(mi.Vector3f, second, ring) * direction.y
    tangent = dr.gather(mi.Vector3f, ravel(circles.tangent), ring)
    value = {name: dr.gather(mi.Float, getattr(circles, name), ring) for name in ("across", "along", "upright", "lean")}
    position = dr.gather(mi.Vector3f, ravel(circles.centre), ring) + outward * value["across"] + tangent * value["along"]
    bend = dr.dot(outward, dr.gather(mi.Vector3f, ravel(circles.bend), ring))
    normal = dr.normalize(outward * (value["upright"] * dr.maximum(1 - bend, _LEAST_UPRIGHT)) + tangent * value["lean"])
    u = (mi.Float(corner) + dr.gather(mi.Float, layout.shift, ring)) / layout.corners + dr.gather(mi.Float, turns, ring)
    return ravel(position), ravel(normal), ravel(mi.Point2f(u, dr.gather(mi.Float, layout.v, ring)))


def _frames(layout: Layout, tangent: Vector3f) -> tuple[Float, Float, Float]:
    """Unit vectors to each circle's first corner and to a quarter turn from it (Float (3R,) each), and u of that corner (R,).

    The choice of the first corner is detached. Gradients keep the circles across the curve, and u as in Mitsuba.
    """
    with dr.suspend_grad():
        t = dr.detach(tangent)
        zero, quarter = _frame_of_u(t)
        before, carried = (dr.gather(mi.Vector3f, ravel(value), layout.previous) for value in (t, zero))
        # The smallest rotation between the two tangents.
        carried -= (before + t) * (dr.dot(t, carried) / dr.maximum(1 + dr.dot(before, t), 1e-6))
        sine, cosine = dr.dot(carried, quarter), dr.dot(carried, zero)
        angle = dr.cumsum(dr.atan2(sine, cosine))
        angle -= dr.gather(mi.Float, angle, layout.first)
        sine, cosine = dr.sincos(angle)
        start = zero * cosine + quarter * sine
    first = dr.normalize(start - tangent * dr.dot(tangent, start))
    zero, quarter = _frame_of_u(tangent)
    sine, cosine = dr.dot(first, quarter), dr.dot(first, zero)
    turns = replace_grad(angle, dr.atan2(sine, cosine)) * dr.inv_two_pi
    return ravel(first), ravel(dr.cross(tangent, first)), turns


def _frame_of_u(tangent: Vector3f) -> tuple[Vector3f, Vector3f]:
    """Unit vectors to u = 0 and u = 1/4 of Mitsuba's curves. The second leans to z, or to y where the tangent is z itself."""
    lean = mi.Vector3f(0, 0, 1) - tangent * tangent.z
    singular = dr.squared_norm(lean) < 1e-10
    other = mi.Vector3f(0, 1, 0) - tangent * tangent.y
    quarter = normalize_or(dr.select(singular, other, lean), mi.Vector3f(0, 1, 0))
    return dr.cross(quarter, tangent), quarter

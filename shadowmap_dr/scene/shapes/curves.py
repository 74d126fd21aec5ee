"""Mitsuba's curves as tubes: a plan of their circles, and the places of the circles for given control points.

B-spline curves are swept circles with open ends. Linear curves are cones that touch spheres about their control points. The
spheres show as end caps, and in the gaps between cones at bends.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...errors import ShadowmapError
from ...jit.arrays import device_array
from ...jit.types import Float, UInt32, Vector3f, Vector4f
from ...jit.vectors import normalize_or
from .tubes import Circles, Layout

# Half the latitude, in radians, that a joint of a linear curve spans beyond its bend. With 0 the circles of a joint would
# coincide on a straight curve, and count as one when the curve is bent later. Cones become thinner by half the square of this.
_JOINT = 0.05
# Where the derivative of a B-spline vanishes, its direction is taken at this distance inside the segment (in its parameter).
_INSIDE = 0.02


@dataclass(frozen=True)
class BSplines:
    """Uniform cubic B-splines: R circles.

    start  UInt32 (R,)  first of the four control points
    local  Float  (R,)  where on the segment, 0 to 1
    """

    start: UInt32
    local: Float

    points_of_segment = 4

    @classmethod
    def plan(cls, segments: np.ndarray, around: int, along: int) -> tuple[BSplines, Layout]:
        """Plan for segments given by their first control points (S,): ``along`` circles each, ``around`` corners per circle."""
        start: list[int] = []
        local: list[float] = []
        v: list[float] = []
        first: list[int] = []
        for begin, end in _runs(segments):
            first += [len(start)] * ((end - begin) * along + 1)
            for number in range(begin, end):
                # A segment's end is the next one's start.
                places = np.arange(along + (number == end - 1)) / along
                start += [segments[number]] * len(places)
                local += list(places)
                v += list((number + places) / len(segments))
        layout = Layout.of(around, np.array(first), np.array(v), np.zeros(len(v), bool))
        return cls(device_array(mi.UInt32, start), device_array(mi.Float, local)), layout

    def circles(self, control_points: Float) -> Circles:
        """Circles for control points (x, y, z, radius), flat Float (4P,), attached to them."""
        p = [dr.gather(mi.Vector4f, control_points, self.start + k) for k in range(4)]
        d = [p[k + 1] - p[k] for k in range(3)]

        def derivative(v: Float) -> Vector4f:
            return ((1 - v) * (1 - v) * d[0] + (1 + 2 * v * (1 - v)) * d[1] + v * v * d[2]) / 2

        v = self.local
        c = ((1 - v) ** 3 * p[0] + (4 - 6 * v * v + 3 * v**3) * p[1] + (1 + 3 * (v + v * v - v**3)) * p[2] + v**3 * p[3]) / 6
        c_v = derivative(v)
        size = sum(dr.squared_norm(_xyz(part)) for part in d)
        # Coinciding control points, as is usual at the ends of curves.
        stands = dr.squared_norm(_xyz(c_v)) <= 1e-8 * size
        c_v = dr.select(stands, derivative(v + (0.5 - v) * (2 * _INSIDE)), c_v)
        c_vv = _xyz((1 - v) * (d[1] - d[0]) + v * (d[2] - d[1]))
        tangent = normalize_or(_xyz(c_v), mi.Vector3f(0, 0, 1))
        speed = dr.squared_norm(_xyz(c_v))
        positive = dr.select(speed > 0, speed, 1)
        inverse = dr.select(speed > 0, dr.rcp(positive), 0)
        bend = (c_vv - tangent * dr.dot(tangent, c_vv)) * (inverse * c.w)
        lean = -c_v.w * dr.sqrt(dr.select(speed > 0, inverse, 1))
        nothing, all_of_it = (dr.full(mi.Float, value, dr.width(v)) for value in (0, 1))
        return Circles(mi.Point3f(_xyz(c)), tangent, c.w, nothing, all_of_it, lean, bend)


@dataclass(frozen=True)
class Polylines:
    """Linear curves: R circles on the spheres about control points.

    centre         UInt32 (R,)  control point
    before, after  UInt32 (R,)  first control points of the segments that meet there; the same at the ends of a curve
    bent           Float  (R,)  position on the bend between these segments, 0 to 1
    shift          Float  (R,)  offset of the latitude, in radians
    cap            Float  (R,)  position between cone and pole of a cap: 0 to 1 at the end of a curve, 0 to -1 at its start
    """

    centre: UInt32
    before: UInt32
    after: UInt32
    bent: Float
    shift: Float
    cap: Float

    points_of_segment = 2

    @classmethod
    def plan(cls, segments: np.ndarray, around: int, along: int) -> tuple[Polylines, Layout]:
        """Plan for segments given by their first control points (S,), with ``around`` corners per circle.

        ``along`` is ignored: segments are straight. Caps and joints have a quarter of ``around`` rows of triangles.
        """
        del along
        steps = max(around // 4, 2)
        rows: list[tuple[float, ...]] = []  # centre, before, after, bent, shift, cap, v
        first = []
        for begin, end in _runs(segments):
            curve: list[tuple[float, ...]] = []
            for number in range(begin, end):
                point, v = segments[number], number / len(segments)
                if number == begin:
                    curve += [(point, point, point, 0.0, 0.0, k / steps - 1, v) for k in range(steps + 1)]
                else:
                    share = [k / steps for k in range(steps + 1)]
                    curve += [(point, point - 1, point, s, _JOINT * (2 * s - 1), 0.0, v) for s in share]
            point, v = segments[end - 1], end / len(segments)
            curve += [(point + 1, point, point, 0.0, 0.0, k / steps, v) for k in range(steps + 1)]
            first += [len(rows)] * len(curve)
            rows += curve
        table = np.array(rows, np.float64)
        layout = Layout.of(around, np.array(first), table[:, 6], np.abs(table[:, 5]) == 1)
        centre, before, after = (device_array(mi.UInt32, column) for column in table.T[:3])
        bent, shift, cap = (device_array(mi.Float, column) for column in table.T[3:6])
        return cls(centre, before, after, bent, shift, cap), layout

    def circles(self, control_points: Float) -> Circles:
        """Circles for control points (x, y, z, radius), flat Float (4P,), attached to them."""
        t0, latitude0 = _cone(control_points, self.before)
        t1, latitude1 = _cone(control_points, self.after)
        tangent = _between(t0, t1, self.bent)
        latitude = dr.lerp(latitude0, latitude1, self.bent)
        latitude = latitude * (1 - dr.abs(self.cap)) + self.cap * (math.pi / 2)
        lean, upright = dr.sincos(latitude)  # without the shift, so that normals of joints and cones agree where they meet
        sine, cosine = dr.sincos(dr.clip(latitude + self.shift, -math.pi / 2, math.pi / 2))
        cosine = dr.select(dr.abs(self.cap) == 1, 0, cosine)  # a pole is one point, to the last bit
        point = dr.gather(mi.Vector4f, control_points, self.centre)
        across, along = point.w * cosine, point.w * sine
        straight = dr.zeros(mi.Vector3f, dr.width(self.cap))
        return Circles(mi.Point3f(_xyz(point)), tangent, across, along, upright, lean, straight)


def check_control_points(name: str, control_points: np.ndarray, segments: np.ndarray, points_of_segment: int) -> None:
    """Refuse curves, with control points (P, 4), that cannot be drawn. Raises ShadowmapError."""
    if not len(segments):
        raise ShadowmapError(f"Curve '{name}' has no segments: remove it.")
    needed = int(segments.max()) + points_of_segment
    if needed > len(control_points):
        raise ShadowmapError(
            f"Segment {int(np.argmax(segments))} of curve '{name}' needs {needed} control points, but there are only "
            f"{len(control_points)}."
        )
    bad = np.flatnonzero(~np.isfinite(control_points).all(-1))
    if len(bad):
        raise ShadowmapError(
            f"Control point {bad[0]} of curve '{name}' is {control_points[bad[0]].tolist()}: positions and radii must be finite."
        )
    radius = control_points[:, 3]
    if radius.min() < 0:
        where = int(np.argmin(radius))
        raise ShadowmapError(f"Control point {where} of curve '{name}' has the radius {radius[where]}: give 0 or more.")
    if not radius.any():
        raise ShadowmapError(f"Curve '{name}' has the radius 0 at all control points: give it a thickness or remove it.")


def _runs(segments: np.ndarray) -> list[tuple[int, int]]:
    """Segments ``begin .. end`` of each curve. Segments whose control points follow one another belong to one curve."""
    breaks = (np.flatnonzero(np.diff(segments.astype(np.int64)) != 1) + 1).tolist()
    return list(zip([0, *breaks], [*breaks, len(segments)], strict=True))


def _cone(control_points: Float, start: UInt32) -> tuple[Vector3f, Float]:
    """Unit direction of segments and the latitude, in radians, of the circles in which their cones touch the spheres."""
    first, second = (dr.gather(mi.Vector4f, control_points, start + k) for k in (0, 1))
    step = second - first
    squared = dr.squared_norm(_xyz(step))
    inverse = dr.rsqrt(dr.maximum(squared, 1e-20))
    # If one sphere lies inside the other, no cone touches both; the latitude is that of a cone that almost does.
    return normalize_or(_xyz(step), mi.Vector3f(0, 0, 1)), dr.asin(dr.clip(-step.w * inverse, -0.999, 0.999))


def _between(first: Vector3f, second: Vector3f, share: Float) -> Vector3f:
    """Unit vectors on the shorter arc from ``first`` (``share`` 0) to ``second`` (1). The interpolation weights are detached."""
    with dr.suspend_grad():
        cosine = dr.dot(first, second)
        angle = dr.acos(dr.clip(cosine, -1, 1))
        small = angle < 1e-2
        scale = dr.rcp(dr.select(small, 1, dr.sin(angle)))
        weights = [dr.select(small, part, dr.sin(part * angle) * scale) for part in (1 - share, share)]
        # Opposite vectors have no shorter arc: any arc will do.
        opposite = cosine < -0.9999
        sine, cosine = dr.sincos(angle * share)
        w0, w1 = dr.select(opposite, cosine, weights[0]), dr.select(opposite, 0, weights[1])
        aside = dr.select(opposite, mi.coordinate_system(first)[0] * sine, 0)
    return dr.normalize(first * w0 + second * w1 + aside)


def _xyz(point: Vector4f) -> Vector3f:
    return mi.Vector3f(point.x, point.y, point.z)

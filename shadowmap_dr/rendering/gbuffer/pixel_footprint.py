"""Sample points spread over a pixel's footprint on a surface, and means over them."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import drjit as dr
import mitsuba as mi

from ...jit.arrays import backend
from ...jit.broadcast import Copies, copied
from ...jit.kernel_inputs import float_input
from ...jit.types import Bool, Color3f, Float, Point3f, Vector3f
from ...scene.lights.soft_outline import Footprints
from ...scene.sensor import ImageSize, Sensor

# Grids of up to this many points a side get an array for each point; larger grids do so if one array would exceed that length.
_WRITTEN_OUT = 2
_MOST_LANES = 1 << 22
# Least cosine between viewing direction and normal. At grazing angles the footprint grows without bound.
_LEAST_SLOPE = 0.25


def footprint_points(
    sensor: Sensor, size: ImageSize, depth: Float | None, p_world: Point3f, n_world: Vector3f, count: int
) -> list[Point3f]:
    """``count`` x ``count`` points spread over a pixel's footprint on the tangent plane of what it sees (Point3f each).

    Attached to ``p_world`` only: the spread itself is detached. ``depth`` is that of
    :class:`~shadowmap_dr.rendering.gbuffer.surface_points.SurfacePoints`, or None.
    """
    if count == 1:
        return [p_world]
    with dr.suspend_grad():
        axes = _Axes.of(sensor, size, depth, p_world, n_world)
        offsets = [axes.offset((i + 0.5) / count - 0.5, (j + 0.5) / count - 0.5) for j in range(count) for i in range(count)]
    return [p_world + offset for offset in offsets]


def footprints(sensor: Sensor, size: ImageSize, depth: Float | None, n_world: Vector3f) -> Footprints:
    """The points of :func:`footprint_points` half way to the pixels' corners, for some of the pixels. Arguments as there."""
    with dr.suspend_grad():
        right, up, _ = _extent(sensor, size, depth)
        # Along a slanted surface, at most so many times as far.
        reach = 0.25 * (1 + 1 / _LEAST_SLOPE) * (dr.norm(right) + dr.norm(up))

    def points(p_world: Point3f, n_world: Vector3f, depth: Float | None = None) -> list[Point3f]:
        return footprint_points(sensor, size, depth, p_world, n_world, 2)

    return Footprints((dr.detach(n_world), *([] if depth is None else [dr.detach(depth)])), points, reach)


@dataclass(frozen=True)
class FootprintSamples:
    """The points of :func:`footprint_points` for all pixels, for means over them.

    Many points of few pixels are stored in one array: the first point of all pixels, then the second, and so on. Written out one
    by one, all would be compiled, in a time that grows faster than their number. Few points are an array each. So are the points
    of large images, which have enough lanes already, and no memory for more.

    Attributes:
        points: Point3f (C N,) each, attached to the pixels' own points.
        active: Bool (C N,).
        copies: C, the number of points of a pixel in one array.
    """

    points: list[Point3f]
    active: Bool
    copies: int

    @classmethod
    def of(
        cls,
        sensor: Sensor,
        size: ImageSize,
        depth: Float | None,
        p_world: Point3f,
        n_world: Vector3f,
        active: Bool,
        count: int,
    ) -> FootprintSamples:
        """``count`` x ``count`` points of each of N pixels. ``active``: Bool (N,); others as in :func:`footprint_points`."""
        copies = count * count
        if count <= _WRITTEN_OUT or copies * dr.width(p_world) > _MOST_LANES:
            return cls(footprint_points(sensor, size, depth, p_world, n_world, count), active, 1)
        dr.eval(p_world, n_world, depth, active)
        # As `Copies` types it, for numbers and vectors alike.
        (points,) = cast("list[Point3f]", dr.custom(Copies, cast("list[Float]", [p_world]), copies, False))
        with dr.suspend_grad():
            number = dr.arange(mi.UInt32, copies * dr.width(p_world)) // dr.width(p_world)
            row = number // count
            depth = None if depth is None else copied(dr.detach(depth), copies)
            axes = _Axes.of(sensor, size, depth, points, copied(dr.detach(n_world), copies))
            across, down = ((mi.Float(k) + 0.5) / count - 0.5 for k in (number - row * count, row))
            offset = axes.offset(across, down)
        return cls([points + offset], copied(active, copies), copies)

    def mean(self, look_up: Callable[[Point3f, Bool], Float | Color3f]) -> Float | Color3f:
        """Mean (N) of the values that ``look_up`` returns for points (Point3f) and their masks (Bool). Attached."""
        found = [cast("Float", look_up(points, self.active)) for points in self.points]
        total: Float = functools.reduce(operator.add, found)
        if self.copies > 1:
            (total,) = dr.custom(Copies, [total], self.copies, True)
        return total * (1 / (self.copies * len(self.points)))


def _extent(sensor: Sensor, size: ImageSize, depth: Float | None) -> tuple[Vector3f, Vector3f, Vector3f]:
    """(width and height of pixels at their depth, as world-space vectors; direction of the camera's axis). Detached."""
    matrix = dr.detach(sensor.to_world.matrix)
    columns = [mi.Vector3f(matrix[0, k], matrix[1, k], matrix[2, k]) for k in range(3)]
    axes: list[Vector3f] = [dr.normalize(column) for column in columns]
    right, up, forward = axes
    projection: Any = dr.detach(sensor.projection)  # Any: in the stub the entries of matrices are vectors
    if sensor.kind == "perspective":
        assert depth is not None, "perspective cameras have depths"
        scale = dr.detach(depth)
    else:
        # An orthographic camera's scale lies in its transformation, whose columns were normalised above.
        scale = mi.Float(1)
        right *= dr.norm(columns[0])
        up *= dr.norm(columns[1])
    module = backend(scale)
    right *= float_input(module, "width", 2 / size.width) / dr.abs(projection[0, 0]) * scale
    up *= float_input(module, "height", 2 / size.height) / dr.abs(projection[1, 1]) * scale
    return right, up, forward


@dataclass(frozen=True)
class _Axes:
    """Width and height of a pixel at its surface as world-space vectors (``right``, ``up``), and the surface's slant.

    ``view`` is the viewing direction, ``normal`` the surface's normal, ``slope`` their cosine, kept away from 0.
    """

    right: Vector3f
    up: Vector3f
    view: Vector3f
    normal: Vector3f
    slope: Float

    @classmethod
    def of(cls, sensor: Sensor, size: ImageSize, depth: Float | None, p_world: Point3f, n_world: Vector3f) -> _Axes:
        right, up, forward = _extent(sensor, size, depth)
        view = forward
        if sensor.kind == "perspective":
            view = dr.normalize(dr.detach(p_world) - dr.detach(sensor.origin))
        n = dr.detach(n_world)
        slope = dr.dot(n, view)
        # At grazing angles the footprint grows without bound: it is cut off at a length of four pixels.
        slope = dr.select(slope < 0, dr.minimum(slope, -_LEAST_SLOPE), dr.maximum(slope, _LEAST_SLOPE))
        return cls(right, up, view, n, slope)

    def offset(self, across: Float | float, down: Float | float) -> Vector3f:
        """Offset from the pixel's centre to a place in its footprint (Vector3f); arguments in shares of its width and height."""
        lateral = self.right * across + self.up * down
        offset = lateral - self.view * (dr.dot(self.normal, lateral) / self.slope)
        # Projected onto the surface also where the footprint was cut off: points beside the surface would be in shadow.
        return offset - self.normal * dr.dot(self.normal, offset)

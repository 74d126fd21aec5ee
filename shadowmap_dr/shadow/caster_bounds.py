"""Shapes that can cast a shadow. A wall or floor with nothing behind it cannot, and would only waste space in a map."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr

from ..jit.arrays import backend, ravel
from ..jit.kernel_inputs import split, uint_input
from ..jit.types import Bool, Float, Normal3f, Point3f, UInt32, Vector4f
from .light_camera import Views, of_map

#: Fraction of a shape's extent that may sink into the floor on which it stands, before the floor counts as its caster.
SUNK = 0.1
#: Distance from a floor's border that a shape on the floor keeps, as a fraction of the floor's size.
BORDER = 0.01
#: Distance at which shapes touch: a fraction of the smaller one's size, plus (for rounding) a fraction of their coordinates.
TOUCH, ROUNDING = 1e-4, 1e-6


@dataclass(frozen=True)
class Boxes:
    """Axis-aligned boxes of S shapes in world space: corners ``low`` and ``high`` of width S, evaluated, detached."""

    low: Point3f
    high: Point3f

    @property
    def count(self) -> int:
        """Number of boxes S."""
        return dr.width(self.low)

    def corners(self, shape: UInt32, corner: UInt32) -> Point3f:
        """Corners (0 to 7) of the boxes of shapes."""
        scalar, vector = backend(self.low).Float, backend(self.low).Array3f
        ends = [(dr.gather(scalar, self.high[c], shape), dr.gather(scalar, self.low[c], shape)) for c in range(3)]
        return vector(*(dr.select((corner & (1 << c)) != 0, *end) for c, end in enumerate(ends)))


def shape_boxes(p_world: Point3f, shape: UInt32, count: int) -> Boxes:
    """Boxes around ``count`` shapes. ``p_world`` (V,): vertices; ``shape`` (V,): shape of each vertex. Detached."""
    module = backend(shape)
    with dr.suspend_grad():
        p = dr.detach(p_world)
        # Six maxima in one buffer: a reduction costs more to launch than to run.
        extremes = dr.full(module.Float, -dr.inf, 6 * count)
        drawn = dr.isfinite(p.x + p.y + p.z)
        for k, value in enumerate((p.x, p.y, p.z, -p.x, -p.y, -p.z)):
            dr.scatter_reduce(dr.ReduceOp.Max, extremes, value, shape * 6 + k, drawn)
        row = dr.arange(module.UInt32, count) * 6
        values = [dr.gather(module.Float, extremes, row + k) for k in range(6)]
        boxes = Boxes(module.Array3f(*(-v for v in values[3:])), module.Array3f(*values[:3]))
        dr.eval(boxes.low, boxes.high)
        return boxes


def casting_shapes(
    views: Views, planes: tuple[Normal3f, Point3f], planar: Bool, boxes: Boxes, hidden: UInt32 | None = None
) -> Bool:
    """Shapes that can cast a shadow in each map: all but planar shapes with nothing behind them, as seen from the light.

    Args:
        views: cameras of the M maps.
        planes: (normal, point) in world space, of width S: the plane of each planar shape.
        planar: (S,) mask of the planar shapes.
        boxes: boxes of the S shapes.
        hidden: (M,) shape that casts no shadow in each map. None: all shapes may.

    Returns:
        Mask of width M * S (entry ``map * S + shape``), detached.
    """
    module = backend(views.spread)
    with dr.suspend_grad():
        views, shapes = dr.detach(views), boxes.count
        (normal, point) = planes
        dr.eval(normal, point, planar)
        reach = _reach(normal, point, planar, boxes)
        index = dr.arange(module.UInt32, views.count * shapes)
        which, shape = split(index, "shapes", shapes, views.count)
        view = of_map(views, which, views.count)
        n, p = (module.Array3f(*(dr.gather(module.Float, v[c], shape) for c in range(3))) for v in (normal, point))
        above = dr.dot(n, dr.select(view.spread > 0, view.origin - p, -view.forward)) > 0
        behind = dr.gather(module.Float, reach, shape * 2 + dr.select(above, module.UInt32(1), 0)) > 0
        casts = ~dr.gather(module.Bool, planar, shape) | behind
        return casts if hidden is None else casts & (shape != dr.gather(module.UInt32, hidden, which))


def receiving_shapes(views: Views, planes: tuple[Normal3f, Point3f], reflecting: Bool, eyes: Vector4f) -> Bool:
    """Shapes whose light cameras can see in each map: all but planar shapes that are seen from the side that faces away.

    Args:
        views: cameras of the M maps.
        planes: as of :func:`casting_shapes`.
        reflecting: (S,) mask of the planar shapes that send no light to their other side.
        eyes: places of cameras, in homogeneous coordinates, world space.

    Returns:
        As of :func:`casting_shapes`.
    """
    module = backend(views.spread)
    with dr.suspend_grad():
        views, shapes = dr.detach(views), dr.width(reflecting)
        normal, point = planes
        dr.eval(normal, point, reflecting, eyes)
        index = dr.arange(module.UInt32, views.count * shapes)
        which, shape = split(index, "shapes", shapes, views.count)
        view = of_map(views, which, views.count)
        n, p = (module.Array3f(*(dr.gather(module.Float, v[c], shape) for c in range(3))) for v in (normal, point))
        above = dr.dot(n, dr.select(view.spread > 0, view.origin - p, -view.forward)) > 0
        receives = ~dr.gather(module.Bool, reflecting, shape)
        for k in range(dr.width(eyes)):
            eye = [dr.gather(module.Float, eyes[c], module.UInt32(k)) for c in range(4)]
            towards = module.Array3f(*(eye[c] - eye[3] * p[c] for c in range(3)))
            receives |= (dr.dot(n, towards) > 0) == above
        return receives


def _reach(normal: Normal3f, point: Point3f, planar: Bool, boxes: Boxes) -> Float:
    """Reach (2 S) of other shapes' boxes beyond the plane of each planar shape, on either side; at most 0 where they touch it.

    The first tenth of a shape that stands on the plane does not count: the maps shall not change if it sinks in a little.
    """
    module, shapes = backend(boxes.low), boxes.count
    corners = [dr.ravel(end) for end in (boxes.low, boxes.high)]
    dr.eval(corners)
    count = uint_input(module, "shapes", shapes)

    def box_of(shape: UInt32) -> tuple[list[Float], list[Float], Float]:
        low, high = (list(dr.gather(module.Array3f, end, shape)) for end in corners)
        return low, high, dr.maximum(dr.maximum(high[0] - low[0], high[1] - low[1]), high[2] - low[2])

    def add(own, other, before_most, behind_most):  # noqa: ANN001, ANN202
        left, right, own_size = box_of(own)
        low, high, size = box_of(other)
        n, p = ([dr.gather(module.Float, v[c], own) for c in range(3)] for v in (normal, point))
        before, behind, extent, far = (module.Float(0) for _ in range(4))  # ``+=`` changes arrays in place
        stands = module.Bool(True)
        for c in range(3):
            before += n[c] * (dr.select(n[c] > 0, high[c], low[c]) - p[c])
            behind -= n[c] * (dr.select(n[c] > 0, low[c], high[c]) - p[c])
            extent += dr.abs(n[c]) * (high[c] - low[c])
            far = dr.maximum(far, dr.maximum(dr.abs(low[c]), dr.abs(high[c])))
            # A shape stands on the plane if it lies within the plane's outline, at any distance along the normal.
            border, room = BORDER * (right[c] - left[c]), dr.abs(n[c]) * size
            stands &= (low[c] >= left[c] + border - room) & (high[c] <= right[c] - border + room)
        touch = dr.fma(TOUCH, dr.minimum(own_size, size), ROUNDING * far)
        less = dr.select(stands, SUNK * extent, 0) + touch
        counts = own != other
        before_most = dr.select(counts, dr.maximum(before_most, before - less), before_most)
        behind_most = dr.select(counts, dr.maximum(behind_most, behind - less), behind_most)
        return own, other + 1, before_most, behind_most

    # Walls and floors alone look through all shapes: most of thousands of shapes have none.
    begin = (
        dr.arange(module.UInt32, shapes),
        dr.select(planar, module.UInt32(0), count),
        *(module.Float(-dr.inf) for _ in range(2)),
    )
    _, _, *most = dr.while_loop(begin, lambda own, other, *_: other < count, add, mode="symbolic", label="behind a plane")
    reach = ravel(module.Array2f(*most))
    dr.eval(reach)
    return reach

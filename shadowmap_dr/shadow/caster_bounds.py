"""Shapes that can cast a shadow. A wall or floor with nothing behind it cannot, and would only waste space in a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr

from ..jit.arrays import backend, ravel
from ..jit.kernel_inputs import split, uint_input
from ..jit.types import Bool, Float, Normal3f, Point3f, UInt32, Vector4f
from .light_camera import Views, of_map

#: Fraction of a shape's extent that may sink into the floor on which it stands, before the floor counts as its caster; and the
#: same where the floor hides that part from all cameras.
SUNK, SUNK_UNSEEN = 0.1, 0.95
#: Distance from a floor's border that a shape on the floor keeps, as a fraction of the floor's size.
BORDER = 0.01
#: Distance at which shapes touch: a fraction of the smaller one's size, plus (for rounding) a fraction of their coordinates.
TOUCH, ROUNDING = 1e-4, 1e-6
# Most cameras of which it is asked what floors hide from them; rounding of places on a plane, as a fraction of its extent.
_MOST_EYES, _SLACK = 4, 1e-3
_Ends = tuple[Sequence[Float], Sequence[Float]]  # lowest and highest corner of a box


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
    views: Views,
    planes: tuple[Normal3f, Point3f],
    planar: Bool,
    boxes: Boxes,
    hidden: UInt32 | None = None,
    eyes: Vector4f | None = None,
    opaque: Bool | None = None,
) -> Bool:
    """Shapes that can cast a shadow in each map: all but planar shapes with nothing behind them, as seen from the light.

    Args:
        views: cameras of the M maps.
        planes: (normal, point) in world space, of width S: the plane of each planar shape.
        planar: (S,) mask of the planar shapes.
        boxes: boxes of the S shapes.
        hidden: (M,) shape that casts no shadow in each map. None: all shapes may.
        eyes: places of all cameras, in homogeneous coordinates, world space. None: cameras may be anywhere.
        opaque: (S,) mask of the planar shapes that nothing is seen through. None: all.

    Returns:
        Mask of width M * S (entry ``map * S + shape``), detached.
    """
    module = backend(views.spread)
    with dr.suspend_grad():
        views, shapes = dr.detach(views), boxes.count
        (normal, point) = planes
        dr.eval(normal, point, planar)
        covers = planar if opaque is None else planar & opaque
        reach = _reach(normal, point, planar, boxes, covers, None if eyes is None or dr.width(eyes) > _MOST_EYES else eyes)
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


def _reach(normal: Normal3f, point: Point3f, planar: Bool, boxes: Boxes, covers: Bool, eyes: Vector4f | None) -> Float:
    """Reach (2 S) of other shapes' boxes beyond the plane of each planar shape, on either side; at most 0 where they touch it.

    The first tenth of a shape that stands on the plane does not count: the maps shall not change if it sinks in a little.
    Nor does what planes (mask ``covers``) hide from all ``eyes``, unless it is nearly all of a shape.
    """
    module, shapes = backend(boxes.low), boxes.count
    corners = [dr.ravel(end) for end in (boxes.low, boxes.high)]
    dr.eval(corners, covers, eyes)
    cameras = [] if eyes is None else [module.UInt32(k) for k in range(dr.width(eyes))]
    places = [[dr.gather(module.Float, eyes[c], camera) for c in range(4)] for camera in cameras if eyes is not None]
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
        counts = own != other
        most = [before_most, behind_most]
        for k, (reached, side) in enumerate(((before, -1.0), (behind, 1.0))):
            unseen = stands & dr.gather(module.Bool, covers, own)
            for eye in places:
                unseen &= _hides(eye, [side * each for each in n], p, (left, right), (low, high))
            share = dr.select(unseen, SUNK_UNSEEN, SUNK) if places else SUNK
            less = dr.select(stands, share * extent, 0) + touch
            most[k] = dr.select(counts, dr.maximum(most[k], reached - less), most[k])
        before_most, behind_most = most
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


def _hides(eye: Sequence[Float], n: Sequence[Float], p: Sequence[Float], own: _Ends, box: _Ends) -> Bool:
    """True if a planar shape hides the part of a box behind it from a camera: all corners there lie behind its outline.

    Args:
        eye: place of the camera (4 homogeneous coordinates).
        n, p: normal towards the camera's side, and a point, of the plane.
        own: corners (low, high) of the box of the planar shape.
        box: corners of the box.
    """
    height = _dot(n, [eye[c] - eye[3] * p[c] for c in range(3)])
    slack = _SLACK * dr.maximum(dr.maximum(own[1][0] - own[0][0], own[1][1] - own[0][1]), own[1][2] - own[0][2])
    hides = height > 0
    for corner in range(8):
        place = [box[corner >> c & 1][c] for c in range(3)]
        depth = -_dot(n, [place[c] - p[c] for c in range(3)])
        # Where the way to the camera passes through the plane, times a positive number.
        weight = height + eye[3] * depth
        inside = backend(height).Bool(True)
        for c in range(3):
            through = place[c] * height + eye[c] * depth
            border = BORDER * (own[1][c] - own[0][c])
            room = dr.abs(n[c]) * slack
            inside &= (through >= weight * (own[0][c] + border - room)) & (through <= weight * (own[1][c] - border + room))
        hides &= inside | (depth <= 0)
    return hides


def _dot(a: Sequence[Float], b: Sequence[Float]) -> Float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

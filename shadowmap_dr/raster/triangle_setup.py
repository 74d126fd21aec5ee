"""Triangle set-up: edge functions, depth plane, bounds, and the coverage test."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import TypeAlias

import drjit as dr

from ..jit.arrays import backend, reinterpret
from ..jit.kernel_inputs import double_input, float_input, int_input
from ..jit.types import Bool, Float, Float64, Int32, UInt32, UInt64, Vector4f
from .types import precise_rcp

#: Clip-space vertices of triangles.
Corners: TypeAlias = tuple[Vector4f, Vector4f, Vector4f]
#: Coefficients (a, b, c) of an affine function ``a x + b y + c``.
Line: TypeAlias = tuple[Float64, Float64, Float64]
#: Inclusive pixel bounds: first column, first row, last column, last row.
Box: TypeAlias = tuple[Int32, Int32, Int32, Int32]

# Boxes are widened by this many pixels so that rounding in the single-precision edge functions cannot lose a pixel.
_BOX_MARGIN = 1.0 / 512.0
# Distance, in pixels, of an edge that is infinitely far away.
_DISTANT = 1e9


@dataclass(frozen=True)
class Triangles:
    """One lane for each triangle in each image of a batch. Not evaluated, so that later steps can join the same kernel.

    Attributes:
        a, b, c: ``Array4f``: three edge functions ``a x + b y + c`` (x, y in pixels from the image centre, distance in pixels,
            positive inside) and, in the fourth component, NDC depth.
        exact: function that returns the same edges in double precision (:func:`edge_lines`), for a branch of :func:`covers`.
        box: inclusive pixel bounds (first column, first row, last column, last row), inside the image where ``active``.
        active: triangles that may cover a pixel centre.
        fragments: estimate of the number of covered pixel centres, at most the size of the box.
        height, width: of an image.
    """

    a: Vector4f
    b: Vector4f
    c: Vector4f
    exact: Callable[[], tuple[list[Line], Float64]]
    box: Box
    active: Bool
    fragments: Float
    height: int
    width: int


def gather_triangle(positions: Float, faces: UInt32, triangle: UInt32, first_vertex: UInt32, active: Bool | bool) -> Corners:
    """Clip-space corners of triangles; ``first_vertex`` is the index of their image's first vertex. Attached."""
    module = backend(positions)
    i = dr.gather(module.Array3u, faces, triangle, active)
    return tuple(dr.gather(module.Array4f, positions, first_vertex + i[k], active) for k in range(3))


def beside(corners: Sequence[Vector4f]) -> Bool:
    """True for triangles and edges whose corners all lie beyond one side of the image or of the depth range. Cheap."""
    x, y, z, w = ([p[c] for p in corners] for c in range(4))
    outside = backend(corners[0]).Bool(False)
    for values in (x, y, z):
        above, below = backend(corners[0]).Bool(True), backend(corners[0]).Bool(True)
        for value, limit in zip(values, w, strict=True):
            above &= value > limit
            below &= value < -limit
        outside |= above | below
    return outside


def set_up(corners: Corners, height: int, width: int) -> Triangles:
    """Edge functions, depth plane and bounds of triangles with the given clip-space corners.

    Edge functions are cross products of float32 (x, y, w) evaluated in float64: every product is then exact, so the two
    triangles that share an edge get coefficients that are exact negatives, whatever their vertex order or indices.
    """
    module = backend(corners[0])
    Float64, Int32 = module.Float64, module.Int32
    lines, det = edge_lines(corners)
    zs = [Float64(p.z) for p in corners]
    active = dr.isfinite(det) & (det != 0)
    sign = dr.select(det < 0, Float64(-1), Float64(1))
    inv_det = precise_rcp(dr.select(active, det, 1))

    # NDC -> pixels from the image centre: this origin keeps single-precision errors smallest.
    sx, sy = double_input(module, "width", 2.0 / width), double_input(module, "height", 2.0 / height)
    coefficients: list[list[Float]] = [[], [], []]
    for a, b, c in lines:
        norm = dr.sqrt(a * a * (sx * sx) + b * b * (sy * sy))
        # The edge between two corners with w = 0 is infinitely far away: the whole image lies on one side of it.
        distant = norm == 0
        scale = sign / dr.select(distant, 1, norm)
        c = dr.select(distant, dr.sign(c) * _DISTANT, c)
        for store, value in zip(coefficients, (a * sx * scale, b * sy * scale, c * scale), strict=True):
            store.append(module.Float(value))
    plane = [sum(zs[k] * lines[k][c] for k in range(3)) * inv_det for c in range(3)]
    for store, value in zip(coefficients, (plane[0] * sx, plane[1] * sy, plane[2]), strict=True):
        store.append(module.Float(value))

    x_min, y_min, x_max, y_max, seen = _screen_bounds(corners, height, width)
    active &= seen
    m = _BOX_MARGIN
    box = (
        dr.maximum(Int32(dr.ceil(x_min - (0.5 + m))), 0),
        dr.maximum(Int32(dr.ceil(y_min - (0.5 + m))), 0),
        dr.minimum(Int32(dr.floor(x_max - (0.5 - m))), int_input(module, "width", width - 1)),
        dr.minimum(Int32(dr.floor(y_max - (0.5 - m))), int_input(module, "height", height - 1)),
    )
    active &= (box[0] <= box[2]) & (box[1] <= box[3])

    columns, rows = module.Float(box[2] - box[0] + 1), module.Float(box[3] - box[1] + 1)
    # det is twice the area in NDC times the product of the w, where all of them are positive.
    w3 = corners[0].w * corners[1].w * corners[2].w
    before = (corners[0].w > 0) & (corners[1].w > 0) & (corners[2].w > 0)
    area = dr.abs(module.Float(det)) * float_input(module, "pixels", width * height / 8) / dr.select(before, w3, 1)
    fragments = dr.select(before, dr.minimum(area + (columns + rows), columns * rows), columns * rows)
    a, b, c = (module.Array4f(*values) for values in coefficients)
    return Triangles(a, b, c, lambda: (lines, det), box, active, fragments, height, width)


def edge_lines(corners: Corners) -> tuple[list[Line], Float64]:
    """Homogeneous edge lines opposite to vertices 0, 1, 2, and the determinant; its sign orients the lines. Attached."""
    module = backend(corners[0])
    xs, ys, ws = ([module.Float64(p[c]) for p in corners] for c in (0, 1, 3))

    def line(a: int, b: int) -> Line:
        return ys[a] * ws[b] - ys[b] * ws[a], xs[b] * ws[a] - xs[a] * ws[b], xs[a] * ys[b] - xs[b] * ys[a]

    lines = [line(1, 2), line(2, 0), line(0, 1)]
    return lines, lines[0][0] * xs[0] + lines[0][1] * ys[0] + lines[0][2] * ws[0]


def rounding_error(module: ModuleType, height: int, width: int) -> Float:
    """Bound of the error (pixels) of a single-precision edge function anywhere in the image."""
    return float_input(module, "larger side", max(width, height) * 3e-7)


def centred(
    module: ModuleType, row: UInt32 | Int32 | int, column: UInt32 | Int32 | int, height: int, width: int
) -> tuple[Float, Float]:
    """Pixel centres counted from the image centre."""
    left, top = float_input(module, "width", 0.5 - 0.5 * width), float_input(module, "height", 0.5 - 0.5 * height)
    return module.Float(column) + left, module.Float(row) + top


def exact_centres(
    module: ModuleType, row: UInt32 | Int32, column: UInt32 | Int32, height: int, width: int
) -> tuple[Float64, Float64]:
    """NDC of pixel centres, in double precision."""
    x, y = (
        (2 * module.Float64(index) + double_input(module, name, 1 - size)) / double_input(module, name, size)
        for index, name, size in ((column, "width", width), (row, "height", height))
    )
    return x, y


def covers(
    values: Vector4f,
    row: UInt32 | Int32,
    column: UInt32 | Int32,
    height: int,
    width: int,
    exact_lines: Callable[[], tuple[list[Line], Float64]],
) -> Bool:
    """True if a triangle contains a pixel's centre, between the near and the far plane.

    Single precision decides unless the centre lies within rounding error of an edge. In these rare cases double precision
    decides; otherwise rounding around a vertex would leave pinholes, or pixels owned by two triangles.

    Args:
        values: ``Array4f``, the edge functions and the depth at the centre.
        row, column: of the pixel.
        exact_lines: returns (lines, det) of the triangle; called within a branch.
    """
    module = backend(values)
    least = dr.minimum(dr.minimum(values.x, values.y), values.z)
    in_range = (values.w >= -1) & (values.w <= 1)

    def exact(row, column):  # noqa: ANN001, ANN202
        lines, det = exact_lines()
        x, y = exact_centres(module, row, column, height, width)
        covered = module.Bool(True)
        for la, lb, lc in lines:
            la, lb, lc = (dr.select(det < 0, -q, q) for q in (la, lb, lc))
            value = dr.fma(la, x, dr.fma(lb, y, lc))
            # Top-left rule: of the two triangles at an edge exactly one owns the points on it.
            covered &= (value > 0) | ((value == 0) & ((la > 0) | ((la == 0) & (lb > 0))))
        return covered

    undecided = in_range & (dr.abs(least) <= rounding_error(module, height, width))
    covered = dr.if_stmt((row, column), undecided, exact, lambda *_: least > 0, mode="symbolic", label="exact edge test")
    return covered & in_range


def depth_key(depth: Float) -> UInt32:
    """Integers in the order of the (finite) depths."""
    module = backend(depth)
    bits: UInt32 = reinterpret(module.UInt32, depth + 0.0)  # -0 becomes +0
    return bits ^ dr.select(bits >> 31 != 0, module.UInt32(0xFFFFFFFF), module.UInt32(0x80000000))


def fragment_key(depth: Float, triangle: UInt32) -> UInt64:
    """Integers whose minimum is the nearest fragment; of equal depths, the one of the lower triangle index."""
    UInt64 = backend(depth).UInt64
    return (UInt64(depth_key(depth)) << 32) | UInt64(triangle)


def _screen_bounds(corners: Corners, height: int, width: int) -> tuple[Float, Float, Float, Float, Bool]:
    """Pixel bounds of the part of a triangle in front of the near plane, and the mask of triangles within the depth range.

    The bound is the whole image if a visible point has ``w <= 0``; no camera yields such points, but a caller's matrix may.
    """
    module = backend(corners[0])
    x_min, y_min, x_max, y_max = module.Float(dr.inf), module.Float(dr.inf), module.Float(-dr.inf), module.Float(-dr.inf)
    unbounded, beyond_far = module.Bool(False), module.Bool(True)
    near = [p.z + p.w for p in corners]
    for p in corners:
        beyond_far &= p.z > p.w

    def include(x: Float, y: Float, w: Float, use: Bool) -> None:
        nonlocal x_min, y_min, x_max, y_max, unbounded
        ok = use & (w > 0)
        unbounded |= use & ~(w > 0)
        inv = dr.rcp(dr.select(ok, w, 1))
        px, py = x * inv, y * inv
        x_min, x_max = dr.select(ok, dr.minimum(x_min, px), x_min), dr.select(ok, dr.maximum(x_max, px), x_max)
        y_min, y_max = dr.select(ok, dr.minimum(y_min, py), y_min), dr.select(ok, dr.maximum(y_max, py), y_max)

    for p, d in zip(corners, near, strict=True):
        include(p.x, p.y, p.w, d >= 0)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        crosses = (near[a] >= 0) != (near[b] >= 0)
        # Interpolate from the end in front: the other end may be so far behind that rounding would lose the crossing.
        front = near[a] >= 0
        d = dr.select(front, near[a], near[b])
        p, back = dr.select(front, corners[a], corners[b]), dr.select(front, corners[b], corners[a])
        s = d / dr.select(crosses, d - dr.select(front, near[b], near[a]), 1)
        q = dr.fma(back - p, s, p)
        include(q.x, q.y, q.w, crosses)

    # Clamp before the conversion to integers: a vertex near the camera plane projects beyond their range.
    def to_pixel(ndc: Float, name: str, size: int) -> Float:
        half = float_input(module, name, 0.5 * size)
        return dr.clip(dr.fma(ndc, half, half), -2.0, float_input(module, name, size + 2.0))

    seen = ~beyond_far & (unbounded | (x_max >= x_min))
    wide = unbounded | ~seen
    return (
        dr.select(wide, 0, to_pixel(dr.select(wide, 0, x_min), "width", width)),
        dr.select(wide, 0, to_pixel(dr.select(wide, 0, y_min), "height", height)),
        dr.select(wide, float_input(module, "width", width), to_pixel(dr.select(wide, 0, x_max), "width", width)),
        dr.select(wide, float_input(module, "height", height), to_pixel(dr.select(wide, 0, y_max), "height", height)),
        seen,
    )

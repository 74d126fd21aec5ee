"""Visibility: which triangle does each pixel see, and where on it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from ._types import MAX_RESOLUTION, NO_TRIANGLE, RasterOutput, backend, pixel_coordinates
from .grid import CellLists, GridShape, block_pixels, build_cell_lists

# Boxes are widened by this many pixels so that rounding in the single-precision edge functions cannot lose a pixel.
_BOX_MARGIN = 1.0 / 512.0


def rasterize(
    positions: Any,
    faces: Any,
    resolution: tuple[int, int],
    *,
    batch: int | None = None,
    check_indices: bool = True,
    transparent: Callable[[RasterOutput], Any] | None = None,
    layers: int = 4,
) -> RasterOutput:
    """Rasterize one or several images of the same triangles.

    A pixel sees the triangle with the smallest ``z / w`` among those that contain its centre; equal depths go to the
    lower index, so that the result is deterministic. Triangles that share an edge never both own a pixel on it and
    never leave a hole (top-left rule on edge functions that are exact negatives of each other). Triangles are not culled
    by their orientation. Parts with ``w <= 0`` or outside ``-w <= z <= w`` are not drawn.

    Args:
        positions: clip-space vertices, a tensor of shape (V, 4) or (B, V, 4), or a flat ``Float`` array of ``B * V * 4``.
        faces: vertex indices, a tensor of shape (F, 3) or a flat ``UInt32`` array of ``3 F``; the same for all images.
        resolution: (height, width) in pixels, each 1 to 4096. Pixel (row j, column i) has its centre at
            ``ndc = (2 (i + 0.5) / width - 1, 2 (j + 0.5) / height - 1)``: row 0 lies at y = -1.
        batch: number of images B, needed only where ``positions`` is flat and holds more than one.
        check_indices: verify that no index is out of range. This reads back one number; a caller that has checked its
            (constant) faces before switches it off, as it must inside ``dr.freeze``.
        transparent: alpha test. Gets what the pixels see (detached) and returns a mask of those that see through it, to what
            lies behind. No gradients.
        layers: how many surfaces are tested at most, one behind the other; the last one counts as opaque.

    Returns:
        :class:`RasterOutput`; barycentrics and depth carry gradients to ``positions``.

    Raises:
        ValueError: on wrong shapes, an empty mesh, a resolution outside the limits, or an index out of range.

    The method: homogeneous edge functions (Olano and Greer, "Triangle scan conversion using 2D homogeneous coordinates", 1997)
    over a pyramid of screen grids (:mod:`shadowmap_dr.raster.grid`).
    """
    flat, face_indices, batch, vertex_count = check_mesh(positions, faces, batch, check_indices)
    height, width = check_resolution(resolution)
    with dr.suspend_grad():
        size = (batch, vertex_count, height, width)
        triangle, records = _visible_triangles(dr.detach(flat), face_indices, *size, transparent, layers)
    return _locate(flat, face_indices, triangle, records, batch, vertex_count, height, width)


def check_resolution(resolution: tuple[int, int]) -> tuple[int, int]:
    """Validate (height, width)."""
    height, width = (int(r) for r in resolution)
    if not (1 <= height <= MAX_RESOLUTION and 1 <= width <= MAX_RESOLUTION):
        raise ValueError(f"resolution is {height} x {width}; both sides must lie between 1 and {MAX_RESOLUTION}")
    return height, width


def check_mesh(positions: Any, faces: Any, batch: int | None, check_indices: bool) -> tuple[Any, Any, int, int]:
    """Validate and flatten vertices and faces; returns (flat positions, flat faces, batch, vertices per image)."""
    if dr.is_tensor_v(positions):
        shape = tuple(positions.shape)
        if len(shape) not in (2, 3) or shape[-1] != 4:
            raise ValueError(f"positions have shape {shape}; expected (V, 4) or (B, V, 4) clip-space vertices")
        images = shape[0] if len(shape) == 3 else 1
        if batch is not None and batch != images:
            raise ValueError(f"batch={batch} contradicts positions of shape {shape}")
        batch, flat = images, positions.array
    else:
        flat, batch = positions, batch or 1
    if dr.is_tensor_v(faces):
        if len(faces.shape) != 2 or faces.shape[1] != 3:
            raise ValueError(f"faces have shape {tuple(faces.shape)}; expected (F, 3)")
        faces = faces.array
    count = dr.width(flat)
    if count == 0 or count % (4 * batch) != 0:
        raise ValueError(f"positions hold {count} numbers, which is not {batch} image(s) of one or more 4-component vertices")
    if dr.width(faces) == 0 or dr.width(faces) % 3 != 0:
        raise ValueError(f"faces hold {dr.width(faces)} indices, which is not one or more triangles")
    faces = backend(flat).UInt32(faces)
    vertex_count = count // (4 * batch)
    if check_indices:
        largest = int(np.max(dr.max(faces).numpy()))
        if largest >= vertex_count:
            raise ValueError(f"faces refer to vertex {largest}, but there are only {vertex_count} vertices")
    return flat, faces, batch, vertex_count


def gather_triangle(positions: Any, faces: Any, triangle: Any, first_vertex: Any, active: Any) -> tuple[Any, Any, Any]:
    """Clip-space corners (``Array4f``) of triangles of one image of the batch."""
    module = backend(positions)
    i = dr.gather(module.Array3u, faces, triangle, active)
    return tuple(dr.gather(module.Array4f, positions, first_vertex + i[k], active) for k in range(3))


def _locate(
    positions: Any, faces: Any, triangle: Any, records: Any, batch: int, vertex_count: int, height: int, width: int
) -> RasterOutput:
    """Perspective-correct barycentrics and depth of each pixel centre on its (given) triangle, attached to ``positions``.

    The corners are sheared so that the pixel's ray becomes the origin; the cross products of pairs of them are then the
    barycentrics up to a factor, free of cancellation for small triangles and without a division by any ``w``.
    """
    module = backend(positions)
    image, row, column = pixel_coordinates(module, batch, height, width)
    (x, x_rest), (y, y_rest) = _exact_ndc(module, column, width), _exact_ndc(module, row, height)
    hit = triangle != NO_TRIANGLE
    p0, p1, p2 = gather_triangle(positions, faces, triangle, image * vertex_count, hit)

    def shear(p: Any) -> tuple[Any, Any]:
        return dr.fma(-p.w, x_rest, dr.fma(-p.w, x, p.x)), dr.fma(-p.w, y_rest, dr.fma(-p.w, y, p.y))

    (x0, y0), (x1, y1), (x2, y2) = shear(p0), shear(p1), shear(p2)
    b0, b1, b2 = cross2(x1, y1, x2, y2), cross2(x2, y2, x0, y0), cross2(x0, y0, x1, y1)
    total = b0 + b1 + b2
    inv = dr.rcp(dr.select(total == 0, 1, total))
    u, v = b1 * inv, b2 * inv
    t = 1 - u - v
    z = dr.fma(t, p0.z, dr.fma(u, p1.z, v * p2.z))
    w = dr.fma(t, p0.w, dr.fma(u, p1.w, v * p2.w))
    depth = z / dr.select(hit, w, 1)
    return RasterOutput(
        triangle,
        dr.select(hit, u, 0),
        dr.select(hit, v, 0),
        dr.select(hit, depth, 1),
        dr.select(hit, w, 1),
        records,
        dr.width(faces) // 3,
        batch,
        height,
        width,
    )


def cross2(ax: Any, ay: Any, bx: Any, by: Any) -> Any:
    """``ax * by - ay * bx`` without cancellation error (Kahan's compensated difference of products)."""
    product = ay * bx
    rounding = dr.detach(dr.fma(-ay, bx, product))
    return dr.fma(ax, by, -product) + rounding


def _exact_ndc(module: Any, index: Any, size: int) -> tuple[Any, Any]:
    """NDC coordinate of a pixel centre as a sum of two floats: on steep triangles, half an ulp of it shows in the depth."""
    numerator = dr.fma(module.Float(index), 2.0, 1.0 - size)
    ndc = numerator / size
    return ndc, dr.fma(-ndc, size, numerator) / size


def _visible_triangles(
    positions: Any,
    faces: Any,
    batch: int,
    vertex_count: int,
    height: int,
    width: int,
    transparent: Callable[[RasterOutput], Any] | None,
    layers: int,
) -> tuple[Any, Any]:
    shape = GridShape(batch, height, width)
    face_count = dr.width(faces) // 3
    records, image, box, active = _set_up(positions, faces, batch, vertex_count, face_count, height, width)
    lists = build_cell_lists(shape, image, box, active)
    triangle = _walk(lists, records, positions, faces, vertex_count)
    for _ in range(layers - 1 if transparent is not None else 0):
        seen = _locate(positions, faces, triangle, records, batch, vertex_count, height, width)
        through = seen.valid & dr.detach(transparent(seen))
        triangle = _walk(lists, records, positions, faces, vertex_count, triangle, through)
    return triangle, records


def _set_up(
    positions: Any, faces: Any, batch: int, vertex_count: int, face_count: int, height: int, width: int
) -> tuple[Any, Any, tuple[Any, Any, Any, Any], Any]:
    """Edge functions, depth plane (12 floats a triangle) and pixel box of every triangle of every image.

    Edge functions are cross products of float32 (x, y, w) evaluated in float64: every product is then exact, so the two
    triangles that share an edge get coefficients that are exact negatives, whatever their vertex order or indices.
    """
    module = backend(positions)
    Float, Float64, UInt32, Int32 = module.Float, module.Float64, module.UInt32, module.Int32
    index = dr.arange(UInt32, batch * face_count)
    image = index // face_count
    corners = gather_triangle(positions, faces, index - image * face_count, image * vertex_count, True)
    lines, det = _edge_lines(corners)
    zs = [Float64(p.z) for p in corners]
    finite = dr.isfinite(det)
    active = finite & (det != 0)
    sign = dr.select(det < 0, Float64(-1), Float64(1))
    inv_det = dr.rcp(dr.select(active, det, 1))

    # NDC -> pixels counted from the image centre, where single precision loses least.
    sx, sy = 2.0 / width, 2.0 / height
    edge = [[], [], []]
    for a, b, c in lines:
        norm = dr.sqrt(a * a * (sx * sx) + b * b * (sy * sy))
        active &= norm > 0
        scale = sign / dr.select(norm > 0, norm, 1)
        for store, value in zip(edge, (a * sx * scale, b * sy * scale, c * scale), strict=True):
            store.append(Float(value))
    plane = [sum(zs[k] * lines[k][c] for k in range(3)) * inv_det for c in range(3)]
    edge[0].append(Float(plane[0] * sx))
    edge[1].append(Float(plane[1] * sy))
    edge[2].append(Float(plane[2]))

    records = dr.empty(Float, 12 * batch * face_count)
    for k in range(3):
        dr.scatter(records, module.Array4f(*edge[k]), 3 * index + k)

    x_min, y_min, x_max, y_max, seen = _screen_bounds(corners, height, width)
    active &= seen
    m = _BOX_MARGIN
    box = (
        dr.maximum(Int32(dr.ceil(x_min - (0.5 + m))), 0),
        dr.maximum(Int32(dr.ceil(y_min - (0.5 + m))), 0),
        dr.minimum(Int32(dr.floor(x_max - (0.5 - m))), width - 1),
        dr.minimum(Int32(dr.floor(y_max - (0.5 - m))), height - 1),
    )
    active &= (box[0] <= box[2]) & (box[1] <= box[3])
    dr.eval(records, box, active)
    return records, image, box, active


def _edge_lines(corners: tuple[Any, Any, Any]) -> tuple[list[tuple[Any, Any, Any]], Any]:
    """Homogeneous lines (opposite to vertices 0, 1, 2) and their common determinant, in double precision."""
    module = backend(corners[0])
    xs, ys, ws = ([module.Float64(p[c]) for p in corners] for c in (0, 1, 3))

    def line(a: int, b: int) -> tuple[Any, Any, Any]:
        return ys[a] * ws[b] - ys[b] * ws[a], xs[b] * ws[a] - xs[a] * ws[b], xs[a] * ys[b] - xs[b] * ys[a]

    lines = [line(1, 2), line(2, 0), line(0, 1)]
    return lines, lines[0][0] * xs[0] + lines[0][1] * ys[0] + lines[0][2] * ws[0]


def _screen_bounds(corners: tuple[Any, Any, Any], height: int, width: int) -> tuple[Any, Any, Any, Any, Any]:
    """Pixel bounds of the part of a triangle in front of the near plane, and whether there is any within the depth range.

    Where a visible point has ``w <= 0`` (no camera does that, but a caller's matrix may), the whole image is the bound.
    """
    module = backend(corners[0])
    Float, Bool = module.Float, module.Bool
    x_min, y_min, x_max, y_max = Float(dr.inf), Float(dr.inf), Float(-dr.inf), Float(-dr.inf)
    unbounded, beyond_far = Bool(False), Bool(True)
    near = [p.z + p.w for p in corners]
    for p in corners:
        beyond_far &= p.z > p.w

    def include(x: Any, y: Any, w: Any, use: Any) -> None:
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
        s = near[a] / dr.select(crosses, near[a] - near[b], 1)
        q = dr.fma(corners[b] - corners[a], s, corners[a])
        include(q.x, q.y, q.w, crosses)

    # Clamp before the conversion to integers: a vertex near the camera plane projects beyond their range.
    def to_pixel(ndc: Any, size: int) -> Any:
        return dr.clip(dr.fma(ndc, 0.5 * size, 0.5 * size), -2.0, size + 2.0)

    seen = ~beyond_far & (unbounded | (x_max >= x_min))
    wide = unbounded | ~seen
    return (
        dr.select(wide, 0, to_pixel(dr.select(wide, 0, x_min), width)),
        dr.select(wide, 0, to_pixel(dr.select(wide, 0, y_min), height)),
        dr.select(wide, width, to_pixel(dr.select(wide, 0, x_max), width)),
        dr.select(wide, height, to_pixel(dr.select(wide, 0, y_max), height)),
        seen,
    )


def _walk(
    lists: CellLists,
    records: Any,
    positions: Any,
    faces: Any,
    vertex_count: int,
    previous: Any = None,
    through: Any = None,
) -> Any:
    """The nearest covering triangle of each pixel, row-major; or the next one behind ``previous`` where ``through`` says so."""
    module = backend(records)
    Float, UInt32 = module.Float, module.UInt32
    shape = lists.shape
    pixel = block_pixels(shape, module)

    def visit(triangle, row, column, best_depth, best):  # noqa: ANN001, ANN202
        covered, depth = _cover(records, positions, faces, triangle, vertex_count, row, column, shape)
        nearer = covered & ((depth < best_depth) | ((depth == best_depth) & (triangle < best)))
        return dr.select(nearer, depth, best_depth), dr.select(nearer, triangle, best)

    def visit_behind(triangle, row, column, best_depth, best, last_depth, last):  # noqa: ANN001, ANN202
        covered, depth = _cover(records, positions, faces, triangle, vertex_count, row, column, shape)
        covered &= (depth > last_depth) | ((depth == last_depth) & (triangle > last))
        nearer = covered & ((depth < best_depth) | ((depth == best_depth) & (triangle < best)))
        return dr.select(nearer, depth, best_depth), dr.select(nearer, triangle, best), last_depth, last

    start = (Float(dr.inf), UInt32(NO_TRIANGLE))
    if previous is None:
        _, best = lists.walk(pixel, start, visit)
    else:
        skip = dr.gather(module.Bool, through, pixel.index, pixel.inside)
        kept = dr.gather(UInt32, previous, pixel.index, pixel.inside)
        last = dr.select(kept == NO_TRIANGLE, 0, kept + pixel.image * (dr.width(faces) // 3))
        _, last_depth = _cover(records, positions, faces, last, vertex_count, pixel.row, pixel.column, shape)
        _, best, _, _ = lists.walk(pixel, (*start, last_depth, last), visit_behind, skip)
        best = dr.select(skip | (kept == NO_TRIANGLE), best, last)
    triangle = dr.select(best == NO_TRIANGLE, best, best - pixel.image * (dr.width(faces) // 3))
    out = dr.empty(UInt32, shape.batch * shape.height * shape.width)
    dr.scatter(out, triangle, pixel.index, pixel.inside)
    dr.eval(out)
    return out


def _cover(
    records: Any, positions: Any, faces: Any, candidate: Any, vertex_count: int, row: Any, column: Any, shape: GridShape
) -> tuple[Any, Any]:
    """Does a triangle contain a pixel's centre, and at what depth?

    Single precision decides unless the centre lies within its rounding error of an edge. There (rarely) double precision
    does, for otherwise the rounded edges that meet in a vertex would leave pinholes or doubly owned pixels around it.
    """
    module = backend(records)
    Float, Float64, Array4f = module.Float, module.Float64, module.Array4f
    px = Float(column) + (0.5 - 0.5 * shape.width)
    py = Float(row) + (0.5 - 0.5 * shape.height)
    a, b, c = (dr.gather(Array4f, records, 3 * candidate + k) for k in range(3))
    e = dr.fma(a, px, dr.fma(b, py, c))
    least = dr.minimum(dr.minimum(e.x, e.y), e.z)
    in_range = (e.w >= -1) & (e.w <= 1)
    rounding = max(shape.width, shape.height) * 3e-7

    def exact(candidate, row, column):  # noqa: ANN001, ANN202
        face_count = dr.width(faces) // 3
        image = candidate // face_count
        corners = gather_triangle(positions, faces, candidate - image * face_count, image * vertex_count, True)
        lines, det = _edge_lines(corners)
        x = (2 * Float64(column) + (1 - shape.width)) / shape.width
        y = (2 * Float64(row) + (1 - shape.height)) / shape.height
        covered = module.Bool(True)
        for la, lb, lc in lines:
            la, lb, lc = (dr.select(det < 0, -q, q) for q in (la, lb, lc))
            value = dr.fma(la, x, dr.fma(lb, y, lc))
            covered &= (value > 0) | ((value == 0) & ((la > 0) | ((la == 0) & (lb > 0))))
        return covered

    undecided = in_range & (dr.abs(least) <= rounding)
    covered = dr.if_stmt(
        (candidate, row, column), undecided, exact, lambda candidate, row, column: least > 0,
        mode="symbolic", label="exact edge test",
    )  # fmt: skip
    return covered & in_range, e.w

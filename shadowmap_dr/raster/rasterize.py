"""Visibility: the triangle that each pixel sees, and the barycentrics of the seen point."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from operator import index
from types import ModuleType
from typing import Any, cast

import drjit as dr

from ..jit.arrays import backend, replace_grad
from ..jit.handover import computed
from ..jit.kernel_inputs import float_input, split, uint_input
from ..jit.types import Bool, Float, Float64, TensorXf, TensorXu, UInt32, UInt64, Vector4f
from .barycentrics import pixel_barycentrics
from .small_triangles import EMPTY, draw
from .tile_lists import STRIP, Strips, TileGrid, TileLists, build_tile_lists, cover, no_covers, strips
from .triangle_setup import Line, Triangles, beside, centred, covers, edge_lines, fragment_key, gather_triangle, set_up
from .types import MAX_RESOLUTION, NO_TRIANGLE, RasterOutput, Records, check_array, check_range, pixel_coordinates

#: A triangle that covers more pixels than this, and is not thin, goes through the lists of tiles.
_LARGE = 512
#: More pixels than this are cleared by all threads.
_MANY = 1 << 20


def rasterize(
    positions: TensorXf | Float,
    faces: TensorXu | UInt32,
    resolution: tuple[int, int],
    *,
    batch: int | None = None,
    check_indices: bool = True,
    transparent: Callable[[RasterOutput], Bool] | None = None,
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
        check_indices: verify that no index is out of range. This reads back one number. Switch it off for (constant) faces
            that have been checked before, and inside ``dr.freeze``.
        transparent: alpha test. A function of a :class:`RasterOutput` (detached) that returns the mask of pixels whose surface
            is transparent there; these pixels see the surface behind it. No gradients.
        layers: maximum number of surfaces tested for each pixel, front to back. The last surface counts as opaque.

    Returns:
        :class:`RasterOutput`; barycentrics and depth carry gradients to ``positions``.

    Raises:
        ValueError: on wrong shapes, an empty mesh, a resolution outside the limits, or an index out of range.

    The method: homogeneous edge functions (Olano and Greer, "Triangle scan conversion using 2D homogeneous coordinates", 1997);
    small and thin triangles draw their fragments themselves (:mod:`shadowmap_dr.raster.small_triangles`), pixels look for the
    large ones in the list of their tile (:mod:`shadowmap_dr.raster.tile_lists`).
    """
    flat, face_indices, batch, _ = check_mesh(positions, faces, batch, check_indices)
    seen = visible_triangles(flat, face_indices, resolution, batch=batch, transparent=transparent, layers=layers)
    return _with_barycentrics(seen, flat, face_indices)


def locate(raster: RasterOutput, positions: Float, faces: UInt32) -> RasterOutput:
    """Barycentrics and depths of the triangles that pixels see, again, attached to ``positions``.

    Args:
        raster: from :func:`rasterize` or :func:`visible_triangles`. Only its triangles and their records are read.
        positions, faces: flat, as rasterized.
    """
    size = raster.batch, dr.width(positions) // (4 * raster.batch), raster.height, raster.width
    return _with_barycentrics(located(positions, faces, raster.triangle, raster.records, *size), positions, faces)


def with_triangles(raster: RasterOutput, triangle: UInt32, positions: Float, faces: UInt32) -> RasterOutput:
    """A raster of the same images that sees other triangles, attached to ``positions``.

    Args:
        raster: from :func:`rasterize` or :func:`visible_triangles`. Its records are read.
        triangle: triangle of each pixel; the pixel's centre lies on it.
        positions, faces: flat, as rasterized.
    """
    size = raster.batch, dr.width(positions) // (4 * raster.batch), raster.height, raster.width
    return located(positions, faces, triangle, raster.records, *size)


def _with_barycentrics(seen: RasterOutput, positions: Float, faces: UInt32) -> RasterOutput:
    u, v, depth = pixel_barycentrics(seen, positions, faces)
    if dr.grad_enabled(positions):
        u, v, depth = (replace_grad(a, b) for a, b in ((u, seen.u), (v, seen.v), (depth, seen.depth)))
    return replace(seen, u=u, v=v, depth=depth)


def visible_triangles(
    positions: TensorXf | Float,
    faces: TensorXu | UInt32,
    resolution: tuple[int, int],
    *,
    batch: int | None = None,
    transparent: Callable[[RasterOutput], Bool] | None = None,
    layers: int = 4,
    one_sided: Bool | None = None,
    drawn: Bool | None = None,
) -> RasterOutput:
    """As :func:`rasterize`, for positions and faces known to be valid, without the cost of barycentrics and depths.

    Barycentrics and depths are attached but not evaluated, so that they cost nothing unless they are used.

    Args:
        one_sided: faces, (F,) or (B F,) for each image, that are drawn only if their corners run from +x to -y, that is,
            clockwise where y points up.
        drawn: faces, (F,), that are drawn at all; None for all of them. The others have records, too.
    """
    flat, face_indices, batch, vertex_count = check_mesh(positions, faces, batch, False)
    size = (batch, vertex_count, *check_resolution(resolution))
    with dr.suspend_grad():
        triangle, records = computed(
            "visible triangles",
            lambda: _visible_triangles(dr.detach(flat), face_indices, *size, transparent, layers, one_sided, drawn),
        )
    return located(flat, face_indices, triangle, records, *size)


def check_resolution(resolution: tuple[int, int]) -> tuple[int, int]:
    """Validate (height, width)."""
    try:
        height, width = (index(r) for r in resolution)
    except (TypeError, ValueError):
        raise ValueError(f"resolution is {resolution!r}; give (height, width) in whole pixels") from None
    if not (1 <= height <= MAX_RESOLUTION and 1 <= width <= MAX_RESOLUTION):
        raise ValueError(f"resolution is {height} x {width}; both sides must lie between 1 and {MAX_RESOLUTION}")
    return height, width


def check_mesh(
    positions: TensorXf | Float, faces: TensorXu | UInt32, batch: int | None, check_indices: bool
) -> tuple[Float, UInt32, int, int]:
    """Validate and flatten vertices and faces; returns (flat positions, flat faces, batch, vertices per image)."""
    check_array("positions", positions)
    check_array("faces", faces, integer=True)
    if dr.is_tensor_v(positions):
        shape = tuple(positions.shape)
        if len(shape) not in (2, 3) or shape[-1] != 4:
            raise ValueError(f"positions have shape {shape}; expected (V, 4) or (B, V, 4) clip-space vertices")
        images = shape[0] if len(shape) == 3 else 1
        if batch is not None and batch != images:
            raise ValueError(f"batch={batch} contradicts positions of shape {shape}")
        batch, flat = images, positions.array
    else:
        flat, batch = cast("Float", positions), 1 if batch is None else batch
        if batch < 1:
            raise ValueError(f"batch is {batch}; give 1 or more images")
    if dr.is_tensor_v(faces):
        if len(faces.shape) != 2 or faces.shape[1] != 3:
            raise ValueError(f"faces have shape {tuple(faces.shape)}; expected (F, 3)")
        faces = faces.array
    count = dr.width(flat)
    if count == 0 or count % (4 * batch) != 0:
        raise ValueError(f"positions hold {count} numbers, which is not {batch} image(s) of one or more 4-component vertices")
    if dr.width(faces) == 0 or dr.width(faces) % 3 != 0:
        raise ValueError(f"faces hold {dr.width(faces)} indices, which is not one or more triangles")
    indices: UInt32 = backend(flat).UInt32(faces)
    vertex_count = count // (4 * batch)
    if check_indices:
        check_range(indices, vertex_count, "vertex")
    return flat, indices, batch, vertex_count


def located(
    positions: Float, faces: UInt32, triangle: UInt32, records: Records, batch: int, vertex_count: int, height: int, width: int
) -> RasterOutput:
    """Perspective-correct barycentrics and depth of each pixel centre on its (given) triangle, attached to ``positions``.

    The corners are sheared so that the pixel's ray becomes the origin; the cross products of pairs of them are then the
    barycentrics up to a factor, free of cancellation for small triangles and without a division by any ``w``.
    """
    module = backend(positions)
    image, row, column = pixel_coordinates(module, batch, height, width)
    (x, x_rest), (y, y_rest) = _exact_ndc(module, column, "width", width), _exact_ndc(module, row, "height", height)
    hit = triangle != NO_TRIANGLE
    p0, p1, p2 = gather_triangle(positions, faces, triangle, image * uint_input(module, "vertices", vertex_count), hit)

    def shear(p: Vector4f) -> tuple[Float, Float]:
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


def cross2(ax: Float, ay: Float, bx: Float, by: Float) -> Float:
    """``ax * by - ay * bx`` without cancellation error (Kahan's compensated difference of products). Attached."""
    product = ay * bx
    rounding = dr.detach(dr.fma(-ay, bx, product))
    return dr.fma(ax, by, -product) + rounding


def _exact_ndc(module: ModuleType, index: UInt32, name: str, size: int) -> tuple[Float, Float]:
    """NDC coordinate of a pixel centre as a sum of two floats: on steep triangles, an error of half an ulp shows in the depth."""
    width = float_input(module, name, size)
    numerator = dr.fma(module.Float(index), 2.0, float_input(module, name, 1.0 - size))
    ndc = numerator / width
    return ndc, dr.fma(-ndc, width, numerator) / width


def _visible_triangles(
    positions: Float,
    faces: UInt32,
    batch: int,
    vertex_count: int,
    height: int,
    width: int,
    transparent: Callable[[RasterOutput], Bool] | None,
    layers: int,
    one_sided: Bool | None = None,
    drawn: Bool | None = None,
) -> tuple[UInt32, Records]:
    """Triangle index of each pixel, row-major, and the records of all triangles."""
    mesh = (positions, faces, batch, vertex_count, height, width)
    if transparent is None:
        return nearest_fragments(*mesh, one_sided=one_sided, drawn=drawn)
    keys, records = nearest_fragments(*mesh, peel=True, one_sided=one_sided, drawn=drawn)
    for _ in range(layers - 1):
        seen = located(positions, faces, triangle_of(keys), records, batch, vertex_count, height, width)
        through = seen.valid & dr.detach(transparent(seen))
        behind = dr.select(through, keys, type(keys)(EMPTY))
        dr.eval(behind)
        farther, records = nearest_fragments(*mesh, behind=behind, peel=True, one_sided=one_sided, drawn=drawn)
        keys = dr.select(through, farther, keys)
        dr.eval(keys)
    return triangle_of(keys), records


def triangle_of(keys: UInt64) -> UInt32:
    """Triangle index of fragment keys: ``NO_TRIANGLE`` for an empty key."""
    return backend(keys).UInt32(keys)


def nearest_fragments(
    positions: Float,
    faces: UInt32,
    batch: int,
    vertex_count: int,
    height: int,
    width: int,
    behind: UInt64 | None = None,
    peel: bool = False,
    one_sided: Bool | None = None,
    drawn: Bool | None = None,
) -> tuple[Any, Records]:
    """Triangle of each pixel, row-major, and the edge functions and depth planes of all triangles (see ``Triangles``).

    Args:
        behind: keys: pixels see only fragments with larger keys, that is, farther ones.
        peel: return fragment keys (``UInt64``, ``EMPTY`` where there is none) instead of triangles (``UInt32``), and keep
            triangles that large ones hide. Keys grow with depth, and with the triangle's index at the same depth.
        one_sided, drawn: see :func:`visible_triangles`.
    """
    module = backend(positions)
    UInt64 = module.UInt64
    face_count = dr.width(faces) // 3
    grid = TileGrid(batch, height, width)
    rows, columns, vertices = (
        uint_input(module, name, size) for name, size in (("height", height), ("width", width), ("vertices", vertex_count))
    )
    # The keys of a tile are contiguous, so that neighbours in the image are near in memory in both directions.
    tiled = not peel and height * width > _LARGE
    keys = _empty_keys(module, grid.pixel_count if tiled else batch * height * width)
    index = dr.arange(module.UInt32, batch * face_count)
    image, triangle = split(index, "faces", face_count, batch)
    total, empty = batch * face_count, height * width <= _LARGE  # no triangle can be large
    # Three flat arrays: Dr.Jit would write the components of a nested array in separate kernels.
    records = tuple(dr.empty(module.Float, 4 * total) for _ in range(3))

    def pixel_index(image: UInt32, row: UInt32, column: UInt32) -> UInt32:
        return grid.pixel(image, row, column) if tiled else (image * rows + row) * columns + column

    def visit(index: UInt32, image: UInt32, triangle: UInt32) -> tuple[UInt32, UInt32, Bool]:
        """Write the records and draw the small triangles. Returns the corners of the boxes, and the large triangles."""
        triangles = set_up(gather_triangle(positions, faces, triangle, image * vertices, True), height, width)
        for record, values in zip(records, (triangles.a, triangles.b, triangles.c), strict=True):
            dr.scatter(record, values, index)
        x0, y0, x1, y1 = triangles.box
        sides = module.Float(x1 - x0 + (y1 - y0) + 2)
        if one_sided is not None:
            _, det = triangles.exact()
            culled = dr.gather(module.Bool, one_sided, triangle if dr.width(one_sided) == face_count else index)
            triangles = replace(triangles, active=triangles.active & ((det < 0) | ~culled))
        if drawn is not None:
            triangles = replace(triangles, active=triangles.active & dr.gather(module.Bool, drawn, triangle))
        small = triangles.active & ((triangles.fragments <= _LARGE) | (triangles.fragments <= 5 * sides))
        draw(triangles, keys, behind, partial(pixel_index, image), triangle, triangles.box, small)
        large = triangles.active & ~small
        if nearest is not None:
            cover(grid, nearest, triangles, image, large)
        first, last = (module.UInt32(x) | (module.UInt32(y) << 16) for x, y in ((x0, y0), (x1, y1)))
        return first, last, large

    nearest = None if peel or empty else no_covers(grid, module)
    # Most triangles of a large scene lie beside a shadow map, or beside what a camera sees.
    near = ~beside(gather_triangle(positions, faces, triangle, image * vertices, True))
    nothing = module.UInt32(0), module.UInt32(0), module.Bool(False)
    first, last, large = dr.if_stmt((index, image, triangle), near, visit, lambda *_: nothing, mode="symbolic", label="triangle")
    dr.eval(records, keys, nearest, large, first, last)
    if empty:
        return keys if peel else triangle_of(keys), records

    def exact_lines(index: UInt32) -> tuple[list[Line], Float64]:
        image, triangle = split(index, "faces", face_count, batch)
        return edge_lines(gather_triangle(positions, faces, triangle, image * vertices, True))

    a, b, c = (dr.gather(module.Array4f, record, index, large) for record in records)
    box = tuple(module.Int32(corner) for corner in (first & 0xFFFF, first >> 16, last & 0xFFFF, last >> 16))
    again = Triangles(a, b, c, lambda: exact_lines(index), box, large, module.Float(0), height, width)
    lists = build_tile_lists(grid, again, index, image, triangle, large, nearest, keys, behind, partial(pixel_index, image))
    strip, kind = strips(grid, module), UInt64 if peel else module.UInt32
    merged = _merge_large(lists, strip, strip.gather(keys, tiled), behind, records, exact_lines, face_count, kind)
    return merged, records


def _empty_keys(module: ModuleType, count: int) -> UInt64:
    if count < _MANY:
        keys = dr.full(module.UInt64, EMPTY, count)
    else:
        # Dr.Jit fills constant arrays with one thread. A kernel of all threads takes a third of the time.
        keys = module.UInt64(EMPTY) ^ module.UInt64(dr.arange(module.UInt32, count) >> 31)
    dr.eval(keys)
    return keys


def _merge_large(
    lists: TileLists,
    strip: Strips,
    best: list[UInt64],
    behind: UInt64 | None,
    records: Records,
    exact_lines: Callable[[UInt32], tuple[list[Line], Float64]],
    face_count: int,
    kind: Callable[[UInt64], UInt32 | UInt64],
) -> UInt32 | UInt64:
    """Nearest fragment of each pixel: of ``best``, the keys after the small triangles, and of the large ones in its tile's list.

    Returns keys or triangle indices, by ``kind``: ``UInt64`` or ``UInt32``.
    """
    grid = lists.grid
    module = backend(best[0])
    UInt32 = module.UInt32
    x, y = centred(module, strip.row, strip.column, grid.height, grid.width)
    beyond = strip.gather(behind) if behind is not None else None
    # Lanes beyond the image walk along with their tile: uniform control flow costs nothing.
    position = strip.tile * lists.capacity
    end = position + dr.minimum(dr.gather(UInt32, lists.count, strip.tile), lists.capacity)

    def visit(position, end, *best):  # noqa: ANN001, ANN002, ANN202
        index = dr.gather(UInt32, lists.items, position)
        a, b, c = (dr.gather(module.Array4f, record, index) for record in records)
        # The pixels of a strip share the look-up of a triangle.
        values = [dr.fma(a, x + k, dr.fma(b, y, c)) for k in range(STRIP)]
        nearer = []
        for k, old in enumerate(best):
            covered = covers(values[k], strip.row, strip.column + k, grid.height, grid.width, lambda: exact_lines(index))
            key = fragment_key(values[k].w, index - strip.image * uint_input(module, "faces", face_count))
            if beyond is not None:
                covered &= key > beyond[k]
            nearer.append(dr.select(covered & (key < old), key, old))
        return position + 1, end, *nearer

    _, _, *best = dr.while_loop(
        (position, end, *best), lambda position, end, *best: position < end, visit, mode="symbolic", label="tile list"
    )
    return strip.written([kind(key) for key in best])

"""Depth and barycentrics of a triangle as affine functions of the pixel.

NDC depth, and barycentrics divided by w, are affine on the screen, in perspective, too. So they are cheap to evaluate, and
gradients of an image of depths can be summed over the pixels of each triangle before they go on to its vertices.
"""

from __future__ import annotations

import drjit as dr

from ..jit.arrays import backend, ravel, replace_grad
from ..jit.branches import branch
from ..jit.handover import interleaved
from ..jit.kernel_inputs import double_input, float_input, split, uint_input, with_current_inputs
from ..jit.types import Bool, Float, UInt32, Vector4f
from .triangle_setup import Corners, beside, edge_lines, exact_centres, gather_triangle
from .types import MAX_RESOLUTION, RasterOutput, pixel_coordinates, precise_rcp

# Smallest determinant (twice the area in NDC times all three w) of a visible triangle.
_LEAST = 1e-25
_COLUMN_BITS = (MAX_RESOLUTION - 1).bit_length()


def pixel_depth(
    raster: RasterOutput, positions: Float, faces: UInt32, reciprocal: Bool | None = None
) -> tuple[Float, Float, Float]:
    """NDC depth of the visible surface (1 where there is none), and its change by column and by row.

    The depth is attached to ``positions``. It equals ``raster.depth`` up to rounding, in value and derivative, and is several
    times cheaper in both directions. The changes are detached, 0 where no triangle is visible.

    Args:
        raster: output of the rasterizer for these positions and faces.
        positions, faces: flat arrays, as rasterized.
        reciprocal: for each image, True to return 1 / w instead of the depth. In perspective, the depth is an affine function
            of 1 / w, whose huge offset (if the near plane is close) would drown 1 / w in rounding.
    """
    if raster.batch * raster.face_count <= dr.width(raster.triangle):
        depths, _ = planes(positions, faces, raster, False, reciprocal)
        return depth_at(depths, *pixels(raster), raster.valid)
    # Most triangles are seen by no pixel: the planes of those that are, for each pixel anew.
    module = backend(positions)
    image, row, column = pixel_coordinates(module, raster.batch, raster.height, raster.width)
    found = _numbers(positions, faces, raster, raster.triangle, image, raster.valid, False, reciprocal)
    return _depth_on(module.Array4f(*found), row, column, raster.valid)


def depth_at(depths: Float, index: UInt32, row: UInt32, column: UInt32, hit: Bool) -> tuple[Float, Float, Float]:
    """Result of :func:`pixel_depth` at any pixels.

    Args:
        depths: first result of :func:`planes`.
        index: index of the triangle in the batch, where a triangle is visible (``hit``).
    """
    return _depth_on(dr.gather(backend(depths).Array4f, depths, index, hit), row, column, hit)


def _depth_on(plane: Vector4f, row: UInt32, column: UInt32, hit: Bool) -> tuple[Float, Float, Float]:
    """Depth of pixels on planes of :func:`planes`, and its changes."""
    x, y = offset(plane, row, column)
    depth = dr.select(hit, dr.fma(plane.x, x, dr.fma(plane.y, y, plane.z)), 1)
    return depth, dr.detach(plane.x), dr.detach(plane.y)


def pixels(raster: RasterOutput) -> tuple[UInt32, UInt32, UInt32]:
    """(index of the triangle in the batch, row, column) of each pixel."""
    module = backend(raster.triangle)
    image, row, column = pixel_coordinates(module, raster.batch, raster.height, raster.width)
    return image * uint_input(module, "faces", raster.face_count) + raster.triangle, row, column


def offset(plane: Vector4f, row: UInt32, column: UInt32) -> tuple[Float, Float]:
    """(columns, rows) from the reference pixel of a triangle's functions."""
    module = backend(plane)
    corner = module.UInt32(dr.detach(plane.w))
    x = module.Float(module.Int32(column) - module.Int32(corner & (MAX_RESOLUTION - 1)))
    return x, module.Float(module.Int32(row) - module.Int32(corner >> _COLUMN_BITS))


def planes(
    positions: Float, faces: UInt32, raster: RasterOutput, barycentrics: bool, reciprocal: Bool | None = None
) -> tuple[Float, tuple[Float, ...]]:
    """Affine functions of the pixel for each triangle of each image: change by column, by row, and value at a reference pixel.

    The reference pixel lies near the triangle: far away from it, small triangles would lose their depth to rounding.

    Args:
        barycentrics: also return the functions of the barycentrics.
        reciprocal: see :func:`pixel_depth`.

    Returns:
        Four numbers for each triangle, flat: the function of the depth (attached) and the packed reference pixel. They are
        evaluated unless barycentrics are asked for. And, if asked for, a tuple (detached): four numbers for each of vertices 1
        and 2, the function of its barycentric divided by w and the change of 1 / w by column (row); and the values of 1 / w.
    """
    module = backend(positions)
    index = dr.arange(module.UInt32, raster.batch * raster.face_count)
    image, triangle = split(index, "faces", raster.face_count, raster.batch)
    first = image * uint_input(module, "vertices", dr.width(positions) // (4 * raster.batch))
    # Triangles beside the image are seen by no pixel. In large scenes most of them are.
    seen = ~beside(dr.detach(gather_triangle(positions, faces, triangle, first, True)))
    found = _numbers(positions, faces, raster, triangle, image, seen, barycentrics, reciprocal)
    if not barycentrics:
        return interleaved("depth planes", list(found)), ()
    depths = ravel(module.Array4f(*found[:4]))
    with dr.suspend_grad():
        rows, inverse_w = found[4:10], found[10:]
        packets = [module.Array4f(*rows[3 * k : 3 * k + 3], inverse_w[k]) for k in range(2)]
        return depths, (*(ravel(packet) for packet in packets), inverse_w[2])


def _numbers(
    positions: Float,
    faces: UInt32,
    raster: RasterOutput,
    triangle: UInt32,
    image: UInt32,
    active: Bool,
    barycentrics: bool,
    reciprocal: Bool | None,
) -> tuple[Float, ...]:
    """Numbers of :func:`planes` for triangles of images where ``active``, zeros elsewhere."""
    module = backend(positions)
    Float64 = module.Float64
    width, height = raster.width, raster.height
    first = image * uint_input(module, "vertices", dr.width(positions) // (4 * raster.batch))

    @with_current_inputs
    def numbers(triangle: UInt32, image: UInt32, first: UInt32) -> tuple[Float, ...]:
        """Numbers of the depth, then of the barycentrics if asked for."""
        corners = gather_triangle(positions, faces, triangle, first, True)
        heights = [p.z for p in corners]
        if reciprocal is not None:
            inverted = dr.gather(module.Bool, reciprocal, image)
            heights = [dr.select(inverted, 1, z) for z in heights]
        with dr.suspend_grad():
            own = dr.detach(corners[0]), dr.detach(corners[1]), dr.detach(corners[2])
            lines, det = edge_lines(own)
            # Degenerate slivers would have infinite weights, and NaN derivatives although no pixel sees them.
            regular = dr.isfinite(det) & (dr.abs(det) > _LEAST)
            inverse = dr.select(regular, precise_rcp(dr.select(regular, det, 1)), 0)
            near = [_pixel_near(own, axis, name, size) for axis, name, size in ((0, "width", width), (1, "height", height))]
            x, y = exact_centres(module, near[1], near[0], height, width)
            # Barycentrics divided by w, at the pixel and their change by column and row.
            change_x = [line[0] * inverse * double_input(module, "width", 2 / width) for line in lines]
            change_y = [line[1] * inverse * double_input(module, "height", 2 / height) for line in lines]
            there = [dr.fma(line[0], x, dr.fma(line[1], y, line[2])) * inverse for line in lines]
            zs = [Float64(dr.detach(z)) for z in heights]
            dx, dy, d = (sum(w * z for w, z in zip(weights, zs, strict=True)) for weights in (change_x, change_y, there))
            slope_x = dx * double_input(module, "width", 0.5 * width)
            slope_y = dy * double_input(module, "height", 0.5 * height)
            slopes = [module.Float(v) for v in (slope_x, slope_y, d - slope_x * x - slope_y * y)]
            weights = [[module.Float(w) for w in row] for row in (change_x, change_y, there)]
            value = [module.Float(v) for v in (dx, dy, d)]
        if dr.grad_enabled(positions):
            # z = A x + B y + C w holds for all corners: the change of the plane balances that of each corner.
            excess = [z - slopes[0] * p.x - slopes[1] * p.y - slopes[2] * p.w for p, z in zip(corners, heights, strict=True)]
            value = [
                replace_grad(v, sum(w * e for w, e in zip(row, excess, strict=True)))
                for v, row in zip(value, weights, strict=True)
            ]
        found = *value, module.Float((near[1] << _COLUMN_BITS) | near[0])
        if not barycentrics:
            return found
        inverse_w = [module.Float(sum(row)) for row in (change_x, change_y, there)]
        return *found, *(row[k] for k in (1, 2) for row in weights), *inverse_w

    zeros = (module.Float(0),) * (13 if barycentrics else 4)
    result: tuple[Float, ...] = branch(active, numbers, lambda *_: zeros, (triangle, image, first), "planes")
    return result


def _pixel_near(corners: Corners, axis: int, name: str, size: int) -> UInt32:
    """Column (axis 0) or row (axis 1) of a pixel in the image close to the corners."""
    module = backend(corners[0])
    middle = module.Float(0)
    for p in corners:
        front = p.w > 0
        ndc = dr.select(front, p[axis] / dr.select(front, p.w, 1), 0)
        middle += dr.clip(ndc, -1, 1) / 3
    place = (middle * 0.5 + 0.5) * float_input(module, name, size)
    return module.UInt32(dr.clip(place, 0, float_input(module, name, size - 1)))

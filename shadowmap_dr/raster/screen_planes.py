"""Triangles as functions of the pixel: depths and barycentrics from a few numbers for each triangle.

NDC depth, and barycentrics divided by w, are affine on the screen, perspective or not. That makes them cheap to evaluate, and
derivatives of an image of depths may be summed up over the pixels of each triangle before they go on to its vertices.
"""

from __future__ import annotations

import drjit as dr

from ..jit.arrays import backend, ravel, replace_grad
from ..jit.types import Bool, Float, UInt32, Vector4f
from .triangle_setup import Corners, edge_lines, gather_triangle
from .types import MAX_RESOLUTION, RasterOutput, by_image, pixel_coordinates, precise_rcp

# Smallest determinant (twice the area in NDC times all w) of a triangle that a pixel may see.
_LEAST = 1e-25
_COLUMN_BITS = (MAX_RESOLUTION - 1).bit_length()


def pixel_depth(
    raster: RasterOutput, positions: Float, faces: UInt32, reciprocal: Bool | None = None
) -> tuple[Float, Float, Float]:
    """NDC depth of what each pixel sees (``Float``, 1 where it sees nothing), and its change by column and row.

    The depth is attached to ``positions``: the same as ``raster.depth`` up to rounding, in value and derivative, and several
    times cheaper in both directions. The changes are detached, 0 where nothing is seen.

    Args:
        raster: of these positions and faces.
        positions, faces: flat arrays, as rasterized.
        reciprocal: ``Bool``, for each image: whether it is to be 1 / w in the place of the depth. In perspective that is the same
            up to a scale and an offset, but next to the offset, which is huge where the near plane is close, it would drown
            in rounding.
    """
    depths, _ = planes(positions, faces, raster, False, reciprocal)
    dr.eval(depths)
    return depth_at(depths, *pixels(raster), raster.valid)


def depth_at(depths: Float, index: UInt32, row: UInt32, column: UInt32, hit: Bool) -> tuple[Float, Float, Float]:
    """Result of :func:`pixel_depth`, for any pixels.

    Args:
        depths: the first result of :func:`planes`.
        index: number of the triangle through the batch, where there is one (``hit``).
    """
    plane = dr.gather(backend(depths).Array4f, depths, index, hit)
    x, y = offset(plane, row, column)
    depth = dr.select(hit, dr.fma(plane.x, x, dr.fma(plane.y, y, plane.z)), 1)
    return depth, dr.detach(plane.x), dr.detach(plane.y)


def pixels(raster: RasterOutput) -> tuple[UInt32, UInt32, UInt32]:
    """(number of the triangle through the batch, row, column) of each pixel."""
    image, row, column = pixel_coordinates(backend(raster.triangle), raster.batch, raster.height, raster.width)
    return image * raster.face_count + raster.triangle, row, column


def offset(plane: Vector4f, row: UInt32, column: UInt32) -> tuple[Float, Float]:
    """Pixels from the one that a triangle's functions refer to."""
    module = backend(plane)
    corner = module.UInt32(dr.detach(plane.w))
    x = module.Float(module.Int32(column) - module.Int32(corner & (MAX_RESOLUTION - 1)))
    return x, module.Float(module.Int32(row) - module.Int32(corner >> _COLUMN_BITS))


def planes(
    positions: Float, faces: UInt32, raster: RasterOutput, barycentrics: bool, reciprocal: Bool | None = None
) -> tuple[Float, tuple[Float, ...]]:
    """Affine functions of the pixel for each triangle of each image: change by column, by row, and value at a pixel.

    That pixel lies near the triangle: far away from it, small triangles would lose their depth to rounding. ``reciprocal``: see
    :func:`pixel_depth`.

    Returns a ``Float`` array with four numbers for each triangle: the function of the depth, attached, and the pixel. And,
    detached and only if asked for, those of the barycentrics of vertices 1 and 2, divided by w, with the changes of 1 / w as
    the fourth numbers, and the values of 1 / w.
    """
    module = backend(positions)
    Float, Float64, UInt32 = module.Float, module.Float64, module.UInt32
    width, height = raster.width, raster.height
    index = dr.arange(UInt32, raster.batch * raster.face_count)
    image, triangle = by_image(index, raster.face_count, raster.batch)
    vertex_count = dr.width(positions) // (4 * raster.batch)
    corners = gather_triangle(positions, faces, triangle, image * vertex_count, True)
    heights = [p.z for p in corners]
    if reciprocal is not None:
        inverted = dr.gather(module.Bool, reciprocal, image)
        heights = [dr.select(inverted, 1, z) for z in heights]
    with dr.suspend_grad():
        own = dr.detach(corners[0]), dr.detach(corners[1]), dr.detach(corners[2])
        lines, det = edge_lines(own)
        # Slivers that hardly are triangles would have infinite weights, and NaN derivatives where no pixel sees them.
        regular = dr.isfinite(det) & (dr.abs(det) > _LEAST)
        inverse = dr.select(regular, precise_rcp(dr.select(regular, det, 1)), 0)
        near = [_pixel_near(own, axis, size) for axis, size in ((0, width), (1, height))]
        # Pixel p has the NDC coordinate (2 p + 1 - size) / size.
        x, y = ((2 * Float64(p) + (1 - size)) / size for p, size in zip(near, (width, height), strict=True))
        # Barycentrics divided by w, at the pixel and their change by column and row.
        change_x = [line[0] * inverse * (2 / width) for line in lines]
        change_y = [line[1] * inverse * (2 / height) for line in lines]
        there = [dr.fma(line[0], x, dr.fma(line[1], y, line[2])) * inverse for line in lines]
        zs = [Float64(dr.detach(z)) for z in heights]
        dx, dy, d = (sum(w * z for w, z in zip(weights, zs, strict=True)) for weights in (change_x, change_y, there))
        slope_x, slope_y = dx * (0.5 * width), dy * (0.5 * height)
        w_part = d - slope_x * x - slope_y * y
        slopes = [Float(v) for v in (slope_x, slope_y, w_part)]
        weights = [[Float(w) for w in row] for row in (change_x, change_y, there)]
        value = [Float(v) for v in (dx, dy, d)]
    if dr.grad_enabled(positions):
        # z = A x + B y + C w holds for all corners: what a corner's change violates, the plane's change makes up for.
        excess = [z - slopes[0] * p.x - slopes[1] * p.y - slopes[2] * p.w for p, z in zip(corners, heights, strict=True)]
        value = [
            replace_grad(v, sum(w * e for w, e in zip(row, excess, strict=True))) for v, row in zip(value, weights, strict=True)
        ]
    depths = ravel(module.Array4f(*value, Float((near[1] << _COLUMN_BITS) | near[0])))
    if not barycentrics:
        return depths, ()
    with dr.suspend_grad():
        inverse_w = [Float(sum(row)) for row in (change_x, change_y, there)]
        packets = [module.Array4f(*(row[k] for row in weights), inverse_w[k - 1]) for k in (1, 2)]
        return depths, (*(ravel(packet) for packet in packets), inverse_w[2])


def _pixel_near(corners: Corners, axis: int, size: int) -> UInt32:
    """Column (axis 0) or row (1) of a pixel of the image close to the corners, ``UInt32``."""
    module = backend(corners[0])
    middle = module.Float(0)
    for p in corners:
        front = p.w > 0
        ndc = dr.select(front, p[axis] / dr.select(front, p.w, 1), 0)
        middle += dr.clip(ndc, -1, 1) / 3
    return module.UInt32(dr.clip((middle * 0.5 + 0.5) * size, 0, size - 1))

"""Depth as a function of the pixel, one for each triangle: the cheapest way to a depth that carries gradients.

NDC depth is affine on the screen, perspective or not. Derivatives of an image of depths may therefore be summed up over the
pixels of each triangle, as those of three numbers, before they go on to its vertices.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from ._types import MAX_RESOLUTION, RasterOutput, backend, pixel_coordinates
from .setup import edge_lines, gather_triangle

# Smallest determinant (twice the area in NDC times all w) of a triangle that a pixel may see.
_LEAST = 1e-25
_COLUMN_BITS = (MAX_RESOLUTION - 1).bit_length()


def pixel_depth(raster: RasterOutput, positions: Any, faces: Any) -> tuple[Any, Any, Any]:
    """NDC depth of what each pixel sees (``Float``, 1 where it sees nothing), and its change by column and row.

    The depth is attached to ``positions``: the same as ``raster.depth`` up to rounding, in value and derivative, and several
    times cheaper in both directions. The changes are detached, 0 where nothing is seen.

    Args:
        raster: of these positions and faces.
        positions, faces: flat arrays, as rasterized.
    """
    module = backend(positions)
    Float, Int32, UInt32 = module.Float, module.Int32, module.UInt32
    planes = _planes(positions, faces, raster)
    dr.eval(planes)
    image, row, column = pixel_coordinates(module, raster.batch, raster.height, raster.width)
    hit = raster.valid
    plane = dr.gather(module.Array4f, planes, image * raster.face_count + raster.triangle, hit)
    corner = UInt32(dr.detach(plane.w))
    x = Float(Int32(column) - Int32(corner & (MAX_RESOLUTION - 1)))
    y = Float(Int32(row) - Int32(corner >> _COLUMN_BITS))
    depth = dr.select(hit, dr.fma(plane.x, x, dr.fma(plane.y, y, plane.z)), 1)
    return depth, dr.detach(plane.x), dr.detach(plane.y)


def _planes(positions: Any, faces: Any, raster: RasterOutput) -> Any:
    """``Float``, four for each triangle of each image: change of depth by column and row, depth at a pixel, that pixel.

    The pixel lies near the triangle: far away from it, small triangles would lose their depth to rounding.
    """
    module = backend(positions)
    Float, Float64, UInt32 = module.Float, module.Float64, module.UInt32
    width, height = raster.width, raster.height
    index = dr.arange(UInt32, raster.batch * raster.face_count)
    image = index // raster.face_count
    vertex_count = dr.width(positions) // (4 * raster.batch)
    corners = gather_triangle(positions, faces, index - image * raster.face_count, image * vertex_count, True)
    with dr.suspend_grad():
        own = [dr.detach(p) for p in corners]
        lines, det = edge_lines(own)
        # Slivers that hardly are triangles would have infinite weights, and NaN derivatives where no pixel sees them.
        regular = dr.isfinite(det) & (dr.abs(det) > _LEAST)
        inverse = dr.select(regular, dr.rcp(dr.select(regular, det, 1)), 0)
        near = [_pixel_near(own, axis, size) for axis, size in ((0, width), (1, height))]
        # Pixel p has the NDC coordinate (2 p + 1 - size) / size.
        x, y = ((2 * Float64(p) + (1 - size)) / size for p, size in zip(near, (width, height), strict=True))
        # Barycentrics divided by w, at the pixel and their change by column and row.
        change_x = [line[0] * inverse * (2 / width) for line in lines]
        change_y = [line[1] * inverse * (2 / height) for line in lines]
        there = [dr.fma(line[0], x, dr.fma(line[1], y, line[2])) * inverse for line in lines]
        zs = [Float64(p.z) for p in own]
        dx, dy, d = (sum(w * z for w, z in zip(weights, zs, strict=True)) for weights in (change_x, change_y, there))
        slope_x, slope_y = dx * (0.5 * width), dy * (0.5 * height)
        w_part = d - slope_x * x - slope_y * y
        slopes = [Float(v) for v in (slope_x, slope_y, w_part)]
        weights = [[Float(w) for w in row] for row in (change_x, change_y, there)]
        value = [Float(v) for v in (dx, dy, d)]
    if dr.grad_enabled(positions):
        # z = A x + B y + C w holds for all corners: what a corner's change violates, the plane's change makes up for.
        excess = [p.z - slopes[0] * p.x - slopes[1] * p.y - slopes[2] * p.w for p in corners]
        value = [
            dr.replace_grad(v, sum(w * e for w, e in zip(row, excess, strict=True)))
            for v, row in zip(value, weights, strict=True)
        ]
    return dr.ravel(module.Array4f(*value, Float((near[1] << _COLUMN_BITS) | near[0])))


def _pixel_near(corners: list[Any], axis: int, size: int) -> Any:
    """Column (axis 0) or row (1) of a pixel of the image close to the corners, ``UInt32``."""
    module = backend(corners[0])
    middle = module.Float(0)
    for p in corners:
        front = p.w > 0
        ndc = dr.select(front, p[axis] / dr.select(front, p.w, 1), 0)
        middle += dr.clip(ndc, -1, 1) / 3
    return module.UInt32(dr.clip((middle * 0.5 + 0.5) * size, 0, size - 1))

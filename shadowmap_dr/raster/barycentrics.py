"""Perspective-correct barycentrics and depths of all pixels, from affine functions of the pixel for each triangle."""

from __future__ import annotations

import drjit as dr

from ..jit.arrays import backend
from ..jit.kernel_inputs import quotient, split, uint_input
from ..jit.types import Bool, Float, UInt32, Vector4f
from .screen_planes import offset, pixels, planes
from .types import NO_TRIANGLE, RasterOutput

# Pixels of a lane: the size of a packet.
_STRIP = 4


def pixel_barycentrics(raster: RasterOutput, positions: Float, faces: UInt32) -> tuple[Float, Float, Float]:
    """Perspective-correct (u, v, NDC depth) of each pixel's centre; (0, 0, 1) where no triangle is visible. Detached."""
    with dr.suspend_grad():
        depths, weights = planes(dr.detach(positions), faces, raster, True)
        dr.eval(depths, weights)
        return _strips(raster, depths, weights) if raster.width % _STRIP == 0 else _each(raster, depths, weights)


def _each(raster: RasterOutput, depths: Float, weights: tuple[Float, ...]) -> tuple[Float, Float, Float]:
    """One pixel a lane."""
    index, row, column = pixels(raster)
    hit = raster.valid
    u, v, depth = _at_pixel(index, row, column, hit, depths, weights)
    return dr.select(hit, u, 0), dr.select(hit, v, 0), dr.select(hit, depth, 1)


def _strips(raster: RasterOutput, depths: Float, weights: tuple[Float, ...]) -> tuple[Float, Float, Float]:
    """Four pixels of a row a lane. Mostly they see the same triangle, and share its look-up."""
    module = backend(depths)
    count = dr.width(raster.triangle)
    lane = dr.arange(module.UInt32, count // _STRIP)
    line = quotient(lane * _STRIP, "width", raster.width)
    column = lane * _STRIP - line * uint_input(module, "width", raster.width)
    image, row = split(line, "height", raster.height, raster.batch)
    base = image * uint_input(module, "faces", raster.face_count)
    triangle = dr.gather(module.Array4u, raster.triangle, lane)
    shared = dr.minimum(dr.minimum(triangle[0], triangle[1]), dr.minimum(triangle[2], triangle[3]))  # NO_TRIANGLE is the largest
    records = _look_up(base + shared, shared != NO_TRIANGLE, depths, weights)
    x, y = offset(records[0], row, column)

    def other(index: UInt32, row: UInt32, column: UInt32, *_: Float) -> tuple[Float, ...]:
        return _at_pixel(index, row, column, True, depths, weights)

    values = []
    for k in range(_STRIP):
        hit = triangle[k] != NO_TRIANGLE
        u, v, depth = dr.if_stmt(
            (base + triangle[k], row, column + k, *_evaluate(records, x + k, y)),
            hit & (triangle[k] != shared),
            other,
            lambda index, row, column, *values: values,
            mode="symbolic",
        )
        values.append((dr.select(hit, u, 0), dr.select(hit, v, 0), dr.select(hit, depth, 1)))
    results = tuple(dr.empty(module.Float, count) for _ in range(3))
    for result, of_pixels in zip(results, zip(*values, strict=True), strict=True):
        dr.scatter(result, module.Array4f(*of_pixels), lane)
    dr.eval(results)
    return results


def _at_pixel(
    index: UInt32, row: UInt32, column: UInt32, active: Bool | bool, depths: Float, weights: tuple[Float, ...]
) -> tuple[Float, Float, Float]:
    records = _look_up(index, active, depths, weights)
    return _evaluate(records, *offset(records[0], row, column))


def _look_up(
    index: UInt32, active: Bool | bool, depths: Float, weights: tuple[Float, ...]
) -> tuple[Vector4f, Vector4f, Vector4f, Float]:
    """Functions of a triangle from `planes`: depth; barycentrics of vertices 1 and 2 divided by w; 1 / w at the pixel."""
    module = backend(depths)
    depth, one, two = (dr.gather(module.Array4f, flat, index, active) for flat in (depths, *weights[:2]))
    return depth, one, two, dr.gather(module.Float, weights[2], index, active)


def _evaluate(records: tuple[Vector4f, Vector4f, Vector4f, Float], x: Float, y: Float) -> tuple[Float, Float, Float]:
    """(u, v, depth) at an offset (``x`` columns, ``y`` rows) from the reference pixel of a triangle's functions."""
    depth, one, two, at_pixel = records
    inverse_w = dr.fma(one.w, x, dr.fma(two.w, y, at_pixel))
    w = dr.rcp(dr.select(inverse_w != 0, inverse_w, 1))
    u, v = (dr.fma(weight.x, x, dr.fma(weight.y, y, weight.z)) * w for weight in (one, two))
    return u, v, dr.fma(depth.x, x, dr.fma(depth.y, y, depth.z))

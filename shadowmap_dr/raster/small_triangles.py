"""Rasterization of small and thin triangles (nearly all triangles), one lane for each.

Each lane walks the rows of its triangle and, in each row, the few columns between its edges. It merges fragments into the image
with an atomic minimum over ``(depth, triangle)`` keys. There are no lists and no sorting.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr

from ..jit.arrays import backend
from ..jit.kernel_inputs import float_input
from ..jit.types import Bool, Int32, UInt32, UInt64, Vector4f
from .triangle_setup import Box, Triangles, centred, covers, fragment_key, rounding_error

#: Key of a pixel that no triangle covers.
EMPTY = 0xFFFFFFFFFFFFFFFF


def draw(
    triangles: Triangles,
    keys: UInt64,
    behind: UInt64 | None,
    pixel_index: Callable[[UInt32, UInt32], UInt32],
    triangle: UInt32,
    box: Box,
    active: Bool,
) -> None:
    """Merge the fragments of triangles into an image of keys; only fragments within each triangle's ``box``.

    Args:
        keys: one for each pixel of the batch; modified.
        behind: None, or one key for each pixel in the order of ``keys``: only fragments with larger keys count.
        pixel_index: function (row, column) -> index into ``keys``, for the triangle's image.
        triangle: index that the keys hold.
        box: inclusive bounds (first column, first row, last column, last row), inside the image.
        active: triangles to draw.
    """
    t = triangles
    module = backend(t.a)
    Float, UInt32 = module.Float, module.UInt32
    x0, y0, x1, y1 = (module.Int32(b) for b in box)
    rounding = rounding_error(module, t.height, t.width)
    width, middle = float_input(module, "width", t.width), float_input(module, "width", 0.5 * t.width - 0.5)
    tiny = 1e-12
    slope = [dr.select(dr.abs(t.a[k]) < tiny, dr.select(t.a[k] < 0, Float(-tiny), Float(tiny)), t.a[k]) for k in range(3)]
    inverse = [dr.rcp(s) for s in slope]

    def span(row: Int32) -> tuple[Vector4f, Int32, Int32]:
        """Edge functions and depth in the middle of a row, and the first and last column between the edges (conservative)."""
        _, y = centred(module, row, 0, t.height, t.width)
        at_middle = dr.fma(t.b, y, t.c)
        # The bounds are widened by rounding errors; the coverage test decides.
        low, high = Float(x0), Float(x1)
        for k in range(3):
            crossing = dr.fma(-at_middle[k], inverse[k], middle)
            error = dr.fma(dr.abs(inverse[k]), rounding, 1e-3)
            low = dr.select(slope[k] > 0, dr.maximum(low, crossing - error), low)
            high = dr.select(slope[k] < 0, dr.minimum(high, crossing + error), high)
        return at_middle, module.Int32(dr.ceil(dr.minimum(low, width))), module.Int32(dr.floor(dr.maximum(high, -1.0)))

    def draw_pixel(row, column, end, at_middle):  # noqa: ANN001, ANN202
        x, _ = centred(module, 0, column, t.height, t.width)
        values = dr.fma(t.a, x, at_middle)
        covered = (column <= end) & covers(values, row, column, t.height, t.width, t.exact)
        key = fragment_key(values.w, triangle)
        pixel = pixel_index(UInt32(row), UInt32(column))
        if behind is not None:
            covered &= key > dr.gather(module.UInt64, behind, pixel, covered)
        # Dr.Jit's default mode, a copy of the image for each thread, would cost far more than a few atomic operations.
        dr.scatter_reduce(dr.ReduceOp.Min, keys, key, pixel, covered, mode=dr.ReduceMode.Direct)
        wrap = column >= end
        row = dr.select(wrap, row + 1, row)
        next_middle, start, next_end = span(row)
        return row, dr.select(wrap, start, column + 1), dr.select(wrap, next_end, end), dr.select(wrap, next_middle, at_middle)

    # One loop instead of two nested ones: a lane proceeds to its next row without waiting for other lanes.
    first, last = dr.select(active, y0, 0), dr.select(active, y1, -1)
    at_middle, start, end = span(first)
    state = (first, start, end, at_middle)
    dr.while_loop(state, lambda row, *_: row <= last, draw_pixel, mode="symbolic", label="fragments")

"""A pyramid of screen grids: which primitives may touch which pixels, in arrays of a size known in advance.

Level ``l`` divides every image of a batch into square cells of ``4 * 2**l`` pixels. A primitive goes to the finest level
at which the box of the pixel centres it may touch overlaps at most 2 x 2 cells, so that ``n`` primitives make at most ``4 n``
list entries. A counting sort puts these into one list per cell. No array size depends on the data, which keeps the program
recordable (``dr.freeze``), and a pixel finds all candidates by walking one list per level.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from ._types import backend

#: log2 of the cell size of the finest level; a 4 x 4 block of pixels is one SIMD packet of 16 lanes.
FINEST = 2


@dataclass(frozen=True)
class GridShape:
    """Cells of all levels of a batch of ``height`` x ``width`` images, numbered level by level."""

    batch: int
    height: int
    width: int

    @property
    def levels(self) -> int:
        """Number of levels; one cell of the last covers the whole image."""
        return max(1, (max(self.height, self.width) - 1).bit_length() - FINEST + 1)

    def columns(self, level: int) -> int:
        return -(-self.width >> (FINEST + level))

    def rows(self, level: int) -> int:
        return -(-self.height >> (FINEST + level))

    def offset(self, level: int) -> int:
        """Number of the first cell of a level within one image."""
        return sum(self.columns(k) * self.rows(k) for k in range(level))

    @property
    def cells_per_image(self) -> int:
        return self.offset(self.levels)

    @property
    def cells(self) -> int:
        return self.batch * self.cells_per_image

    def cell(self, level: int, image: Any, row: Any, column: Any) -> Any:
        """Number of the cell of ``level`` that contains a pixel."""
        shift = FINEST + level
        return image * self.cells_per_image + (row >> shift) * self.columns(level) + (column >> shift) + self.offset(level)


@dataclass(frozen=True)
class CellLists:
    """``items[start[c]:start[c + 1]]`` are the primitives that may touch cell ``c``; their order is not defined."""

    shape: GridShape
    start: Any
    items: Any

    def range(self, level: int, image: Any, row: Any, column: Any, active: Any = True) -> tuple[Any, Any]:
        """First and one-past-last list position for the cell of ``level`` that contains a pixel (empty where inactive)."""
        cell = self.shape.cell(level, image, row, column)
        dtype = type(self.start)
        return dr.gather(dtype, self.start, cell, active), dr.gather(dtype, self.start, cell + 1, active)


def build_cell_lists(shape: GridShape, image: Any, box: tuple[Any, Any, Any, Any], active: Any) -> CellLists:
    """Sort primitives into the cells that their pixel boxes touch.

    Args:
        shape: the grid.
        image: ``UInt32``, the image each primitive belongs to.
        box: ``Int32`` inclusive bounds (first column, first row, last column, last row), inside the image where active.
        active: primitives to sort in; the others get no entry.

    No gradients.
    """
    module = backend(image)
    UInt32 = module.UInt32
    x0, y0, x1, y1 = (UInt32(dr.select(active, b, 0)) for b in box)

    # Walk from the coarsest level to the finest; once a level does not fit, no finer one does.
    cell, columns = UInt32(0), UInt32(0)
    across, down = module.Bool(False), module.Bool(False)
    for level in reversed(range(shape.levels)):
        shift = FINEST + level
        cx0, cx1, cy0, cy1 = x0 >> shift, x1 >> shift, y0 >> shift, y1 >> shift
        fits = (cx1 - cx0 <= 1) & (cy1 - cy0 <= 1)
        cell = dr.select(fits, cy0 * shape.columns(level) + cx0 + shape.offset(level), cell)
        columns = dr.select(fits, shape.columns(level), columns)
        across = dr.select(fits, cx1 > cx0, across)
        down = dr.select(fits, cy1 > cy0, down)
    cell += image * shape.cells_per_image

    # One flat index over all (primitive, corner) candidates: scatter_inc can be evaluated only once for each target.
    count = dr.width(active)
    packed = dr.select(active, UInt32(1) | dr.select(across, UInt32(2), 0) | dr.select(down, UInt32(4), 0), 0)
    dr.eval(cell, columns, packed)
    candidate = dr.arange(UInt32, 4 * count)
    primitive, corner = candidate >> 2, candidate & 3
    flags = dr.gather(UInt32, packed, primitive)
    right, below = corner & 1, corner >> 1
    used = (flags & 1 != 0) & ((right == 0) | (flags & 2 != 0)) & ((below == 0) | (flags & 4 != 0))
    target = dr.gather(UInt32, cell, primitive, used) + right + below * dr.gather(UInt32, columns, primitive, used)

    counter = dr.zeros(UInt32, shape.cells + 1)
    slot = dr.scatter_inc(counter, target, used)
    dr.eval(slot, target, used, counter)
    start = dr.prefix_sum(counter)
    items = dr.empty(UInt32, max(4 * count, 1))
    dr.scatter(items, primitive, dr.gather(UInt32, start, target, used) + slot, used)
    dr.eval(start, items)
    return CellLists(shape, start, items)

"""A pyramid of screen grids: which primitives may touch which pixels, in arrays of a size known in advance.

Level ``l`` divides every image of a batch into square cells of ``4 * 2**l`` pixels. A primitive goes to the finest level
at which the box of the pixel centres it may touch overlaps at most 2 x 2 cells, so that ``n`` primitives make at most ``4 n``
list entries. A counting sort puts these into one list per cell. No array size depends on the data, which keeps the program
recordable (``dr.freeze``), and a pixel finds all candidates by walking one list per level.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
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


@dataclass(frozen=True)
class CellLists:
    """``items[start[c]:start[c + 1]]`` are the primitives that may touch cell ``c``; their order is not defined."""

    shape: GridShape
    start: Any
    items: Any

    def walk(
        self, pixel: BlockPixels, state: tuple[Any, ...], visit: Callable[..., tuple[Any, ...]], active: Any = True
    ) -> tuple[Any, ...]:
        """Visit, for each pixel, all primitives that may touch it: a symbolic loop over levels around one over a list.

        Args:
            pixel: the pixels, one lane each.
            state: Dr.Jit variables that ``visit`` updates.
            visit: ``(primitive, row, column, *state) -> state``.
            active: pixels to walk for.

        Returns the final state.
        """
        UInt32 = type(self.start)
        shape = self.shape

        def level(shift, first_cell, image, row, column, active, *state):  # noqa: ANN001, ANN002, ANN202
            round_up = (UInt32(1) << shift) - 1
            columns, rows = (shape.width + round_up) >> shift, (shape.height + round_up) >> shift
            cell = image * shape.cells_per_image + first_cell + (row >> shift) * columns + (column >> shift)
            # Lanes beyond the image walk along with their block: its cell exists, and uniform control flow costs nothing.
            position = dr.gather(UInt32, self.start, cell, active)
            end = dr.gather(UInt32, self.start, cell + 1, active)

            def entry(position, end, row, column, *state):  # noqa: ANN001, ANN002, ANN202
                primitive = dr.gather(UInt32, self.items, position)
                return position + 1, end, row, column, *visit(primitive, row, column, *state)

            inner = dr.while_loop(
                (position, end, row, column, *state),
                lambda position, end, *_: position < end,
                entry,
                mode="symbolic",
                label="list",
            )
            return shift + 1, first_cell + columns * rows, image, row, column, active, *inner[4:]

        last = FINEST + shape.levels
        result = dr.while_loop(
            (UInt32(FINEST), UInt32(0), pixel.image, pixel.row, pixel.column, dr.mask_t(self.start)(active), *state),
            lambda shift, *_: shift < last,
            level,
            mode="symbolic",
            label="levels",
        )
        return result[6:]


@dataclass(frozen=True)
class BlockPixels:
    """All pixels of a batch of images, 16 consecutive lanes a 4 x 4 block; blocks at the border reach beyond the image.

    ``index`` is the position in a flat row-major batch, valid where ``inside``.
    """

    image: Any
    row: Any
    column: Any
    inside: Any
    index: Any


def block_pixels(shape: GridShape, module: ModuleType) -> BlockPixels:
    """Enumerate the pixels of a grid block by block."""
    size = 1 << FINEST
    block_columns, block_rows = shape.columns(0), shape.rows(0)
    lane = dr.arange(module.UInt32, shape.batch * block_rows * block_columns * size * size)
    block = lane >> (2 * FINEST)
    row_of_blocks = block // block_columns
    image = row_of_blocks // block_rows
    column = (block - row_of_blocks * block_columns) * size + (lane & (size - 1))
    row = (row_of_blocks - image * block_rows) * size + ((lane >> FINEST) & (size - 1))
    inside = (column < shape.width) & (row < shape.height)
    return BlockPixels(image, row, column, inside, (image * shape.height + row) * shape.width + column)


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

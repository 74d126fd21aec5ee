"""Rasterization of large triangles: each tile of 16 x 16 pixels has a short list of triangles, which its pixels walk.

A triangle is not listed for a tile that it misses, or where it lies behind a triangle that covers the tile. Blocks of 4 x 4 tiles
are tested first. Triangles beyond a list's capacity are drawn as small ones are, so that no array size depends on the data.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import ModuleType

import drjit as dr

from ..jit.arrays import backend, scatter_inc
from ..jit.kernel_inputs import float_input, quotient, split, uint_input
from ..jit.types import Bool, UInt32, UInt64
from .small_triangles import draw
from .triangle_setup import Box, Triangles, centred, depth_key, rounding_error

#: log2 of the side of a tile in pixels.
TILE = 4
#: Side of a block in tiles, a power of two.
BLOCK = 4
#: Pixels of a strip.
STRIP = 4
#: Capacity of a tile's list in triangles.
CAPACITY = 32


@dataclass(frozen=True)
class TileGrid:
    """The tiles of a batch of ``height`` x ``width`` images."""

    batch: int
    height: int
    width: int

    @property
    def columns(self) -> int:
        return -(-self.width >> TILE)

    @property
    def rows(self) -> int:
        return -(-self.height >> TILE)

    @property
    def count(self) -> int:
        return self.batch * self.rows * self.columns

    @property
    def block_count(self) -> int:
        return self.batch * self._block_rows * self._block_columns

    @property
    def _block_rows(self) -> int:
        return -(-self.rows // BLOCK)

    @property
    def _block_columns(self) -> int:
        return -(-self.columns // BLOCK)

    @property
    def pixel_count(self) -> int:
        """Number of pixels of all tiles, including those beyond the image."""
        return self.count << (2 * TILE)

    def pixel(self, image: UInt32, row: UInt32, column: UInt32) -> UInt32:
        """Index of a pixel in the tiled order: the pixels of a tile are contiguous, row by row."""
        within = ((row & ((1 << TILE) - 1)) << TILE) + (column & ((1 << TILE) - 1))
        return (self.tile(image, row >> TILE, column >> TILE) << (2 * TILE)) + within

    def tile(self, image: UInt32, row: UInt32, column: UInt32) -> UInt32:
        """Index of the tile in a row and column of tiles."""
        return self._node("tiles", image, row, column, self.rows, self.columns)

    def block(self, image: UInt32, row: UInt32, column: UInt32) -> UInt32:
        """Index of the block that holds the tile in a row and column of tiles."""
        return self._node("blocks", image, row // BLOCK, column // BLOCK, self._block_rows, self._block_columns)

    @staticmethod
    def _node(name: str, image: UInt32, row: UInt32, column: UInt32, rows: int, columns: int) -> UInt32:
        module = backend(row)
        line = image * uint_input(module, f"rows of {name}", rows) + row
        return line * uint_input(module, f"columns of {name}", columns) + column


@dataclass(frozen=True)
class TileLists:
    """Triangles (numbered through the batch) that tile ``c`` may see: ``items[c * capacity:][:count[c]]``.

    ``count`` may exceed the capacity. Triangles beyond it are not listed; they are drawn directly.
    """

    grid: TileGrid
    capacity: int
    count: UInt32
    items: UInt32


@dataclass(frozen=True)
class Strips:
    """All pixels of a batch of images in horizontal strips of four, one lane for each strip. Strips may reach beyond the image.

    16 consecutive lanes make up 16 x 4 pixels of one tile, so that the control flow of a SIMD packet hardly ever diverges.
    ``column`` is the column of the first pixel, ``index`` its position in a flat row-major batch.
    """

    image: UInt32
    row: UInt32
    column: UInt32
    tile: UInt32
    index: UInt32
    images: int
    height: int
    width: int

    def gather(self, flat: UInt64, tiled: bool = False) -> list[UInt64]:
        """Values of the four pixels of each strip, undefined beyond the image.

        Args:
            flat: values of a batch of images, row-major or, if ``tiled``, in the order of :meth:`TileGrid.pixel`.
        """
        if tiled:  # strips are in this order, too
            return list(dr.gather(backend(flat).Array4u64, flat, dr.arange(type(self.tile), dr.width(flat) // STRIP)))
        module = backend(self.row)
        inside, width = self.row < uint_input(module, "height", self.height), uint_input(module, "width", self.width)
        if self.width % STRIP == 0:
            return list(dr.gather(backend(flat).Array4u64, flat, self.index // STRIP, inside & (self.column < width)))
        return [dr.gather(type(flat), flat, self.index + k, inside & (self.column + k < width)) for k in range(STRIP)]

    def written(self, values: Sequence[UInt32 | UInt64]) -> UInt32 | UInt64:
        """A flat row-major batch of images, evaluated, from the values of the four pixels of each strip."""
        kind = type(values[0])
        module = backend(values[0])
        across = -(-self.width // STRIP)
        rows = self.images * self.height
        # One packet scatter for each strip: several scatters would be separate kernels.
        padded = dr.empty(kind, rows * across * STRIP)
        height, width = uint_input(module, "height", self.height), uint_input(module, "width", self.width)
        inside = (self.row < height) & (self.column < width)
        packet = {module.UInt32: module.Array4u, module.UInt64: module.Array4u64}[kind]
        at = (self.image * height + self.row) * uint_input(module, "strips", across) + self.column // STRIP
        dr.scatter(padded, packet(*values), at, inside)
        dr.eval(padded)
        if self.width % STRIP == 0:
            return padded
        pixel = dr.arange(module.UInt32, rows * self.width)
        row = quotient(pixel, "width", self.width)
        result = dr.gather(kind, padded, row * uint_input(module, "padded width", across * STRIP) + (pixel - row * width))
        dr.eval(result)
        return result


def strips(grid: TileGrid, module: ModuleType) -> Strips:
    """Enumerate the strips of a batch of images."""
    lane = dr.arange(module.UInt32, grid.count << (2 * TILE - 2))
    within = lane & ((1 << (2 * TILE - 2)) - 1)
    tile = lane >> (2 * TILE - 2)
    row_of_tiles, column_of_tiles = split(tile, "columns of tiles", grid.columns, grid.batch * grid.rows)
    image, row_within = split(row_of_tiles, "rows of tiles", grid.rows, grid.batch)
    row = (row_within << TILE) + (within >> (TILE - 2))
    column = (column_of_tiles << TILE) + ((within & ((1 << (TILE - 2)) - 1)) * STRIP)
    index = (image * uint_input(module, "height", grid.height) + row) * uint_input(module, "width", grid.width) + column
    return Strips(image, row, column, tile, index, grid.batch, grid.height, grid.width)


def no_covers(grid: TileGrid, module: ModuleType) -> UInt32:
    """Occlusion depths of tiles, then of blocks, before any triangle covers one (:func:`cover`). Evaluated."""
    nearest = dr.full(module.UInt32, 0xFFFFFFFF, grid.count + grid.block_count)
    dr.eval(nearest)
    return nearest


def cover(grid: TileGrid, nearest: UInt32, triangles: Triangles, image: UInt32, active: Bool) -> None:
    """Lower the occlusion depths of tiles and blocks, as :func:`depth_key`: a triangle that covers one lies before this depth.

    Triangles that cover a whole block count for the block, not for its tiles again.
    """
    tiles = uint_input(backend(nearest), "tiles", grid.count)

    def visit(row: UInt32, column: UInt32, is_tile: Bool) -> Bool:
        span = _Span(triangles, row, column, is_tile)
        node = dr.select(is_tile, grid.tile(image, row, column), tiles + grid.block(image, row, column))
        dr.scatter_reduce(dr.ReduceOp.Min, nearest, depth_key(span.farthest), node, span.covered, mode=dr.ReduceMode.Direct)
        return ~span.missed & ~span.covered

    _for_each_tile(triangles.box, active, visit)


def build_tile_lists(
    grid: TileGrid,
    triangles: Triangles,
    index: UInt32,
    image: UInt32,
    triangle: UInt32,
    active: Bool,
    nearest: UInt32 | None,
    keys: UInt64,
    behind: UInt64 | None,
    pixel_index: Callable[[UInt32, UInt32], UInt32],
) -> TileLists:
    """List large triangles for the tiles in which they may be visible.

    Args:
        grid: the tiles.
        triangles: all triangles, one lane for each.
        index, triangle: index of each triangle in the batch, and in its image.
        image: image of each triangle.
        active: mask of the large triangles.
        nearest: from :func:`nearest_covers`, or None to keep hidden triangles, too.
        keys, behind, pixel_index: arguments of :func:`shadowmap_dr.raster.small_triangles.draw` for triangles whose list is full.
    """
    module = backend(triangles.a)
    Int32 = module.Int32
    count = dr.zeros(module.UInt32, grid.count)
    items = dr.empty(module.UInt32, grid.count * CAPACITY)
    dr.eval(count, items)
    tiles = uint_input(module, "tiles", grid.count)

    def visit(row: UInt32, column: UInt32, is_tile: Bool) -> Bool:
        span = _Span(triangles, row, column, is_tile)
        tile = grid.tile(image, row, column)
        seen = ~span.missed
        if nearest is not None:
            depth = depth_key(span.nearest)
            seen &= depth <= dr.gather(module.UInt32, nearest, tiles + grid.block(image, row, column), seen)
            seen &= ~is_tile | (depth <= dr.gather(module.UInt32, nearest, tile, seen & is_tile))
        wanted = seen & is_tile
        slot = scatter_inc(count, tile, wanted)
        fits = wanted & (slot < CAPACITY)
        dr.scatter(items, index, tile * CAPACITY + slot, fits)
        x0, y0, x1, y1 = triangles.box
        left, top = Int32(column << TILE), Int32(row << TILE)
        size = (1 << TILE) - 1
        box = (dr.maximum(x0, left), dr.maximum(y0, top), dr.minimum(x1, left + size), dr.minimum(y1, top + size))
        draw(triangles, keys, behind, pixel_index, triangle, box, wanted & ~fits)
        return seen

    _for_each_tile(triangles.box, active, visit)
    dr.eval(count, items, keys)
    return TileLists(grid, CAPACITY, count, items)


def _for_each_tile(box: Box, active: Bool, visit: Callable[[UInt32, UInt32, Bool], Bool]) -> None:
    """Call ``visit(row, column, is_tile)`` in a symbolic loop over the tiles that a box touches.

    A box of many tiles is walked block by block. A block is visited first (``is_tile`` false, row and column of its first tile);
    its tiles are visited only if ``visit`` returned True for the block.
    """
    module = backend(box[0])
    x0, y0, x1, y1 = (module.UInt32(dr.select(active, b, 0)) >> TILE for b in box)
    few = (x1 - x0 + 1) * (y1 - y0 + 1) <= BLOCK * BLOCK

    def first(top: UInt32, left: UInt32) -> tuple[UInt32, UInt32]:
        """(row, column) of the first visit in the block whose first tile is (``top``, ``left``)."""
        return dr.select(few, dr.maximum(top, y0), top), dr.select(few, dr.maximum(left, x0), left)

    def body(row, column, is_tile):  # noqa: ANN001, ANN202
        descend = visit(row, column, is_tile)
        top, left = row & ~module.UInt32(BLOCK - 1), column & ~module.UInt32(BLOCK - 1)
        right, bottom = dr.minimum(left + BLOCK - 1, x1), dr.minimum(top + BLOCK - 1, y1)
        next_row = is_tile & (column == right)
        leave = dr.select(is_tile, next_row & (row == bottom), ~descend)
        last = left + BLOCK > x1
        block_row, block_column = first(
            dr.select(last, top + BLOCK, top), dr.select(last, x0 & ~module.UInt32(BLOCK - 1), left + BLOCK)
        )
        tile_row = dr.select(is_tile, dr.select(next_row, row + 1, row), dr.maximum(top, y0))
        tile_column = dr.select(is_tile & ~next_row, column + 1, dr.maximum(left, x0))
        row, column = dr.select(leave, block_row, tile_row), dr.select(leave, block_column, tile_column)
        return row, column, ~leave | few

    row, column = first(y0 & ~module.UInt32(BLOCK - 1), x0 & ~module.UInt32(BLOCK - 1))
    state = (dr.select(active, row, y1 + 1), column, few)
    dr.while_loop(state, lambda row, *_: row <= y1, body, mode="symbolic", label="tiles")


class _Span:
    """Relation of a triangle to the pixel centres of a tile or block.

    ``missed``: the triangle contains none of the centres; ``covered``: it contains all; ``nearest``, ``farthest``: bounds of its
    depth there.
    """

    def __init__(self, t: Triangles, row: UInt32, column: UInt32, is_tile: Bool) -> None:
        module = backend(t.a)
        half = dr.select(is_tile, module.Float(0.5 * ((1 << TILE) - 1)), 0.5 * ((BLOCK << TILE) - 1))
        x, y = centred(module, row << TILE, column << TILE, t.height, t.width)
        middle = dr.fma(t.a, x + half, dr.fma(t.b, y + half, t.c))
        reach = (dr.abs(t.a) + dr.abs(t.b)) * half
        error = rounding_error(module, t.height, t.width)
        # Fragments evaluate the depth in another order, with rounding errors relative to the largest term.
        half_width, half_height = float_input(module, "width", 0.5 * t.width), float_input(module, "height", 0.5 * t.height)
        error_depth = 1e-6 * dr.fma(dr.abs(t.a.w), half_width, dr.fma(dr.abs(t.b.w), half_height, dr.abs(t.c.w)))
        self.nearest = middle.w - reach.w - error_depth
        self.farthest = middle.w + reach.w + error_depth
        outside = [middle[k] + reach[k] < -error for k in range(3)]
        inside = [middle[k] - reach[k] > error for k in range(3)]
        self.missed = outside[0] | outside[1] | outside[2] | (self.nearest > 1) | (self.farthest < -1)
        self.covered = inside[0] & inside[1] & inside[2] & (self.nearest >= -1) & (self.farthest <= 1)

"""Tiles of a light's image plane, each with a shadow map of its own: texels go where pixels are.

A k-d tree over visible points divides the image plane of a light into rectangles, each as small as the pixels in it are many. A
rectangle has a map with a window, a depth range and texels of its own. A point belongs to one tile, whatever its depth: a look-up
does not search in depth. Depths count from the plane that fits the tile's visible points best: ground that the light falls on
aslant needs no depth range.

Source: Lauritzen, Salvi and Lefohn, "Sample Distribution Shadow Maps", 2011, who divide depths; here the light's image plane is
divided (Fernando et al., "Adaptive Shadow Maps", 2001, with a quadtree).
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType

import drjit as dr

from ..jit.arrays import backend, ravel
from ..jit.types import Bool, Float, UInt32

#: Width of the band along a border in which two tiles are blended, on either side, in half-widths of the smaller tile's map.
BAND = 0.01
#: Maps of a light: number of the first one, and of its tiles.
Group = tuple[int, int]


@dataclass(frozen=True)
class Tiles:
    """Rectangles of light image planes, one for each of M maps, detached. Maps that are no tiles have an infinite one.

    Attributes:
        low_x, low_y, high_x, high_y: (M,) bounds in the light's image plane; infinite at the outer sides.
        slope_x, slope_y: (M,) change of depth along the light with x and y, on the plane nearest to the visible points; 0 for
            maps that are no tiles, and in perspective. Maps measure depths from that plane.
    """

    low_x: Float
    low_y: Float
    high_x: Float
    high_y: Float
    slope_x: Float
    slope_y: Float

    @classmethod
    def whole(cls, module: ModuleType, count: int) -> Tiles:
        """Infinite rectangles of ``count`` maps, in arrays of a Dr.Jit module."""
        return cls(*(dr.full(module.Float, value, count) for value in (-dr.inf, -dr.inf, dr.inf, dr.inf, 0, 0)))

    def columns(self) -> list[Float]:
        """All numbers, (M,) each, in a fixed order."""
        return [self.low_x, self.low_y, self.high_x, self.high_y, self.slope_x, self.slope_y]

    def rows(self, index: UInt32) -> Tiles:
        """The rectangles of some maps."""
        return Tiles(*(dr.gather(backend(index).Float, column, index) for column in self.columns()))

    def hold(self, x: Float, y: Float) -> Bool:
        """True where points lie inside. Points on a border belong to the upper tile."""
        return (x >= self.low_x) & (x < self.high_x) & (y >= self.low_y) & (y < self.high_y)


def tile_of(tiles: Tiles, group: Group, x: Float, y: Float) -> UInt32:
    """Number of the map whose tile holds points of a light's image plane.

    The tiles of a light are the leaves of a k-d tree, in its order: the first tile in the upper half of a node begins at the
    border of the halves, and differs from the first one in the lower half by that coordinate.
    """
    first, number = group
    module = backend(x)
    corners = ravel(module.Array2f(tiles.low_x, tiles.low_y))
    found = dr.full(module.UInt32, first, dr.width(x))
    low = dr.gather(module.Array2f, corners, found)
    half = number // 2
    while half:
        upper = found + half
        border = dr.gather(module.Array2f, corners, upper)
        beyond = dr.select(border.x > low.x, x >= border.x, y >= border.y)
        found, low = dr.select(beyond, upper, found), dr.select(beyond, border, low)
        half //= 2
    return found


def neighbour(tiles: Tiles, halves: tuple[Float, Float], group: Group, tile: UInt32, x: Float, y: Float) -> tuple[UInt32, Float]:
    """(tile beyond the nearest border, its share of the light) for points that lie in a tile; the share is 0 beyond the band.

    Args:
        tiles: of all maps.
        halves: half-widths and half-heights (M,) of the maps.
        group: maps of the light.
        tile: tile of each point.
        x, y: points in the light's image plane.
    """
    module = backend(x)
    own = tiles.rows(tile)
    gaps = [x - own.low_x, own.high_x - x, y - own.low_y, own.high_y - y]
    sizes = [dr.gather(module.Float, half, tile) for half in halves]
    # The nearest border, as the map's texels count.
    shares = [gap / sizes[k // 2] for k, gap in enumerate(gaps)]
    nearest = dr.minimum(dr.minimum(shares[0], shares[1]), dr.minimum(shares[2], shares[3]))
    near = nearest < BAND
    moves = [dr.select(near & (share == nearest), 2 * gap, 0) for share, gap in zip(shares, gaps, strict=True)]
    across = (shares[0] == nearest) | (shares[1] == nearest)
    # Beyond the border, as far as the point is before it.
    beyond = tile_of(tiles, group, x - moves[0] + moves[1], y - moves[2] + moves[3])
    gap = dr.select(across, nearest * sizes[0], nearest * sizes[1])
    theirs = [dr.gather(module.Float, half, beyond) for half in halves]
    band = BAND * dr.select(across, dr.minimum(sizes[0], theirs[0]), dr.minimum(sizes[1], theirs[1]))
    share = dr.maximum(0.5 - 0.5 * gap / band, 0)
    return beyond, dr.select(near & (beyond != tile), share, 0)

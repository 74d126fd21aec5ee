"""Tiles of a light's image plane, each with a shadow map of its own: texels go where pixels are.

A k-d tree over visible points divides the image plane of a light into rectangles, each as small as the pixels in it are many. A
rectangle has a map with a window, a depth range and texels of its own. A point belongs to one tile, whatever its depth: a look-up
does not search in depth. Depths count from the plane that fits the tile's visible points best: ground that the light falls on
aslant needs no depth range.

Source: Lauritzen, Salvi and Lefohn, "Sample Distribution Shadow Maps", 2011, who divide depths; here the light's image plane is
divided (Fernando et al., "Adaptive Shadow Maps", 2001, with a quadtree).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType

import drjit as dr

from ..jit.arrays import backend
from ..jit.types import Bool, Float, UInt32

#: Width of the band along a border in which two tiles are blended, on either side, in half-widths of the smaller tile's map.
BAND = 0.01
# Most tiles of a light from whose numbers points select: with more, they gather them.
_SELECTED = 8
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

    def by_name(self) -> dict[str, Float]:
        """All numbers, (M,) each."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}

    def rows(self, index: UInt32) -> Tiles:
        """The rectangles of some maps."""
        return Tiles(*(dr.gather(backend(index).Float, column, index) for column in self.columns()))

    def hold(self, x: Float, y: Float) -> Bool:
        """True where points lie inside. Points on a border belong to the upper tile."""
        return (x >= self.low_x) & (x < self.high_x) & (y >= self.low_y) & (y < self.high_y)


#: Numbers of maps, each in an array of its own: by name one for each map.
Rows = Mapping[str, list[Float]]


def rows_of(columns: Mapping[str, Float]) -> Rows:
    """The numbers of all maps (``columns``, (M,) each) as arrays of width 1, evaluated."""
    rows = {
        name: [dr.gather(type(column), column, backend(column).UInt32(k)) for k in range(dr.width(column))]
        for name, column in columns.items()
    }
    dr.eval(rows)
    return rows


@dataclass(frozen=True)
class TileNumbers:
    """Numbers of the maps of one light, read by points for the tile that each lies in. Detached.

    Attributes:
        group: maps of the light, a power of two.
        columns: numbers of all maps, (M,) each, by name.
        rows: the same numbers; None: points gather from ``columns``.

    Selecting from a few numbers that all points share takes a third of the time of gathering one for each point.
    """

    group: Group
    columns: Mapping[str, Float]
    rows: Rows | None = None

    @classmethod
    def of(cls, columns: Mapping[str, Float], group: Group, rows: Rows | None = None) -> TileNumbers:
        """The numbers of the maps of a light (``group``), given those of all maps (``rows``: from :func:`rows_of`)."""
        return cls(group, columns, rows if group[1] <= _SELECTED else None)

    def at(self, names: Sequence[str], tile: UInt32) -> list[Float]:
        """Numbers (those of ``names``) of the map ``tile``, one of the light's, of each point."""
        if self.rows is None:
            return [dr.gather(type(column), column, tile) for column in (self.columns[name] for name in names)]
        first, number = self.group
        place, found = tile - first, [self.rows[name][first : first + number] for name in names]
        while len(found[0]) > 1:
            upper = (place & 1) == 1
            found = [[dr.select(upper, b, a) for a, b in zip(rows[::2], rows[1::2], strict=True)] for rows in found]
            place >>= 1
        return [rows[0] for rows in found]


def tile_of(numbers: TileNumbers, x: Float, y: Float) -> UInt32:
    """Number of the map whose tile holds points of a light's image plane. ``numbers``: with those of ``Tiles``.

    The tiles of a light are the leaves of a k-d tree, in its order: the first tile in the upper half of a node begins at the
    border of the halves, and differs from the first one in the lower half by that coordinate.
    """
    first, number = numbers.group
    names = ("low_x", "low_y")
    found = dr.full(backend(x).UInt32, first, dr.width(x))
    low = numbers.at(names, found)
    half = number // 2
    while half:
        upper = found + half
        border = numbers.at(names, upper)
        beyond = dr.select(border[0] > low[0], x >= border[0], y >= border[1])
        found = dr.select(beyond, upper, found)
        low = [dr.select(beyond, b, a) for a, b in zip(low, border, strict=True)]
        half //= 2
    return found


def neighbour(numbers: TileNumbers, tile: UInt32, x: Float, y: Float) -> tuple[UInt32, Float]:
    """(tile beyond the nearest border, its share of the light) for points that lie in a tile; the share is 0 beyond the band.

    Args:
        numbers: with those of ``Tiles``, and ``half_x`` and ``half_y`` of ``Frusta``.
        tile: tile of each point.
        x, y: points in the light's image plane.
    """
    halves = ("half_x", "half_y")
    low_x, low_y, high_x, high_y, *sizes = numbers.at(("low_x", "low_y", "high_x", "high_y", *halves), tile)
    gaps = [x - low_x, high_x - x, y - low_y, high_y - y]
    # The nearest border, as the map's texels count.
    shares = [gap / sizes[k // 2] for k, gap in enumerate(gaps)]
    beside: Float = dr.minimum(shares[0], shares[1])
    above: Float = dr.minimum(shares[2], shares[3])
    nearest: Float = dr.minimum(beside, above)
    near = nearest < BAND
    moves = [dr.select(near & (share == nearest), 2 * gap, 0) for share, gap in zip(shares, gaps, strict=True)]
    across = (shares[0] == nearest) | (shares[1] == nearest)
    # Beyond the border, as far as the point is before it.
    beyond = tile_of(numbers, x - moves[0] + moves[1], y - moves[2] + moves[3])
    gap = dr.select(across, nearest * sizes[0], nearest * sizes[1])
    narrower = [dr.select(own < other, own, other) for own, other in zip(sizes, numbers.at(halves, beyond), strict=True)]
    band = BAND * dr.select(across, narrower[0], narrower[1])
    share = dr.maximum(0.5 - 0.5 * gap / band, 0)
    return beyond, dr.select(near & (beyond != tile), share, 0)

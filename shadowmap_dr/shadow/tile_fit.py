"""The fit of tiles to visible points: a k-d tree with the smallest texels on the mean, kept while it is about as good."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import drjit as dr

from ..jit.arrays import backend
from ..jit.types import Bool, Float, Point3f, UInt32
from .grouped import grouped_maxima, numbers_of
from .light_camera import Views, of_map, to_light_space
from .nearest_planes import nearest_planes
from .tiles import Group, TileNumbers, Tiles, tile_of

# Bins between which a node may be cut, and the least share of its points on either side.
BINS, _LEAST = 32, 1 / 8
# Tiles are kept while the mean side of texels is at most so many times that of new tiles, and slopes differ by no more than that.
_MOST, _TURN = 1.2, 0.1


def fit_tiles(
    views: Views, groups: Sequence[Group], seen: tuple[Point3f, Bool], previous: Tiles | None, *, planes: bool = True
) -> Tiles | None:
    """Tiles of all lights in ``groups``, or the previous ones while their texels are about as small. Detached.

    A light's tiles have equally many texels. The k-d tree makes the mean side of texels over all visible points small.

    Args:
        views: cameras of the M maps.
        groups: lights with several tiles, a power of two.
        seen: (points in world space, spread over what cameras see; mask of valid points).
        previous: tiles of an earlier call, None if there are none.
        planes: fit planes to the points of each tile, from which depths count.

    Returns:
        None without ``groups``.
    """
    if not groups:
        return None
    module, count = backend(views.spread), views.count
    with dr.suspend_grad():
        index = dr.arange(module.UInt32, count)
        sides = Tiles.whole(module, count).columns()
        for first, number in groups:
            x, y, z, lit = _coordinates(views, first, seen[0])
            lit &= module.Bool(seen[1])
            found = _divided(x, y, lit, number)
            if planes:
                slope_x, slope_y, _ = nearest_planes(
                    (x, y, z), tile_of(TileNumbers.of(found.by_name(), (0, number)), x, y), number, lit
                )
                found = replace(found, slope_x=slope_x, slope_y=slope_y)
            if previous is not None:
                kept = previous.rows(dr.arange(module.UInt32, number) + first)
                # The leaves found are those of one light alone.
                sizes = [_mean_size(each, (at, number), x, y, lit) for each, at in ((previous, first), (found, 0))]
                turned = dr.maximum(dr.abs(kept.slope_x - found.slope_x), dr.abs(kept.slope_y - found.slope_y))
                keep = (sizes[0] <= _MOST * sizes[1]) & (dr.max(turned) <= _TURN)
                found = Tiles(*(dr.select(keep, a, b) for a, b in zip(kept.columns(), found.columns(), strict=True)))
            row = index - first
            own = (index >= first) & (row < number)
            rows = found.rows(dr.select(own, row, 0))
            sides = [dr.select(own, new, old) for new, old in zip(rows.columns(), sides, strict=True)]
        result = Tiles(*sides)
        dr.eval(result)
        return result


def image_coordinates(views: Views, first: int, p_world: Point3f) -> tuple[Float, Float, Bool]:
    """(x, y) of world-space points in the image plane of the light whose first map is given, and a mask of those in its cone.

    Detached.
    """
    x, y, _, inside = _coordinates(views, first, p_world)
    return x, y, inside


def _coordinates(views: Views, first: int, p_world: Point3f) -> tuple[Float, Float, Float, Bool]:
    """As :func:`image_coordinates`, with depths along the light (0 in perspective) after (x, y)."""
    module = backend(views.spread)
    with dr.suspend_grad():
        view = of_map(dr.detach(views), module.UInt32(first), views.count)
        p = to_light_space(view, dr.detach(module.Array3f(p_world)))
        perspective = view.spread > 0
        before = ~perspective | (p.z > 0)
        w = dr.select(perspective & before, p.z, 1)
        x, y = p.x / w, p.y / w
        return (
            x,
            y,
            dr.select(perspective, 0, p.z),
            before & (~perspective | ((dr.abs(x) <= view.spread) & (dr.abs(y) <= view.spread))),
        )


def _divided(x: Float, y: Float, active: Bool, number: int) -> Tiles:
    """A k-d tree's leaves: ``number`` rectangles of the points (x, y), each node cut where :func:`_cuts` says."""
    module = backend(x)
    node = dr.zeros(module.UInt32, dr.width(x))
    leaves = Tiles.whole(module, 1)
    nodes = 1
    while nodes < number:
        across, cut = _cuts(x, y, node, nodes, active)
        child = dr.arange(module.UInt32, 2 * nodes)
        parent, upper = child >> 1, (child & 1) == 1
        sides, in_x, border = leaves.rows(parent), dr.gather(module.Bool, across, parent), dr.gather(module.Float, cut, parent)
        leaves = Tiles(
            dr.select(upper & in_x, border, sides.low_x),
            dr.select(upper & ~in_x, border, sides.low_y),
            dr.select(~upper & in_x, border, sides.high_x),
            dr.select(~upper & ~in_x, border, sides.high_y),
            sides.slope_x,
            sides.slope_y,
        )
        along = dr.select(dr.gather(module.Bool, across, node), x, y)
        node = 2 * node + dr.select(along >= dr.gather(module.Float, cut, node), module.UInt32(1), 0)
        dr.eval(leaves, node)
        nodes *= 2
    return leaves


def _cuts(x: Float, y: Float, node: UInt32, nodes: int, active: Bool) -> tuple[Bool, Float]:
    """(across x, place), (nodes,) each: the cut through each node that leaves the least mean of :func:`_sizes` over its points.

    Candidates are borders between bins with equally many points, along both axes. Without one, a node is cut through its middle.
    """
    module = backend(x)
    # Rows are nodes, cut across x, and again, cut across y. ``value`` is the coordinate that is cut.
    rows = 2 * nodes
    value, other, row = dr.concat([x, y]), dr.concat([y, x]), dr.concat([node, node + nodes])
    active = dr.concat([active, active])
    bin_, (start, length) = even_bins(value, row, rows, active)
    counts = _counts(bin_, rows * BINS, active)
    ends = _maxima([-value, -other, value, other], bin_, rows * BINS, active)
    lower = [dr.block_prefix_reduce(dr.ReduceOp.Max, end, BINS) for end in ends]
    upper = [dr.block_prefix_reduce(dr.ReduceOp.Max, end, BINS, exclusive=False, reverse=True) for end in ends]
    border = dr.arange(module.UInt32, rows * BINS)
    total = dr.maximum(dr.block_sum(counts, BINS), 1)
    below = dr.block_prefix_sum(counts, BINS) / dr.gather(module.Float, total, border // BINS)
    mean = below * _sizes(lower) + (1 - below) * _sizes(upper)
    mean = dr.select((below >= _LEAST) & (below <= 1 - _LEAST), mean, dr.inf)
    place = 0.5 * (lower[2] - upper[0])

    index = dr.arange(module.UInt32, nodes)
    least = dr.block_reduce(dr.ReduceOp.Min, mean, BINS)
    first = dr.block_reduce(
        dr.ReduceOp.Min, dr.select(mean == dr.gather(module.Float, least, border // BINS), border, rows * BINS - 1), BINS
    )
    by_x, by_y = (dr.gather(module.Float, least, index + k * nodes) for k in (0, 1))
    found = dr.minimum(by_x, by_y) < dr.inf
    wide = dr.gather(module.Float, length, index) >= dr.gather(module.Float, length, index + nodes)
    across = dr.select(found, by_x <= by_y, wide)
    chosen = dr.select(across, index, index + nodes)
    middle = dr.gather(module.Float, start, chosen) + 0.5 * dr.gather(module.Float, length, chosen)
    cut = dr.select(found, dr.gather(module.Float, place, dr.gather(module.UInt32, first, chosen)), middle)
    dr.eval(across, cut)
    return across, cut


def even_bins(value: Float, row: UInt32, rows: int, active: Bool) -> tuple[UInt32, tuple[Float, Float]]:
    """(index of each value's bin, (least value, extent) of each row), for bins that hold about equally many values of their row.

    Bins of equal width come first, in which values are taken to lie evenly: most may lie in few of them.
    """
    module = backend(value)
    low, high = _maxima([-value, value], row, rows, active)
    start, length = -low, dr.maximum(high + low, 1e-30)
    dr.eval(start, length)
    place = (value - dr.gather(module.Float, start, row)) / dr.gather(module.Float, length, row)
    wide = _bin(place, active)
    at = row * BINS + wide
    counts = _counts(at, rows * BINS, active)
    before, total = dr.block_prefix_sum(counts, BINS), dr.maximum(dr.block_sum(counts, BINS), 1)
    rank = dr.gather(module.Float, before, at) + (place * BINS - module.Float(wide)) * dr.gather(module.Float, counts, at)
    return row * BINS + _bin(rank / dr.gather(module.Float, total, row), active), (start, length)


def _bin(share: Float, active: Bool) -> UInt32:
    """Number of the bin in which a share from 0 to 1 lies."""
    module = backend(share)
    return dr.minimum(module.UInt32(dr.select(active, dr.maximum(share * BINS, 0), 0)), BINS - 1)


def _counts(index: UInt32, size: int, active: Bool) -> Float:
    """Numbers of points (size,) at each index."""
    module = backend(index)
    counts = dr.zeros(module.UInt32, size)
    dr.scatter_add(counts, module.UInt32(1), index, active)
    return module.Float(counts)


def _maxima(values: Sequence[Float], group: UInt32, count: int, active: Bool) -> list[Float]:
    """Maxima (count,) of each value over the points of each group; minus infinity where there is none."""
    found = grouped_maxima(values, group, count, active)
    return numbers_of(found, dr.arange(backend(group).UInt32, count), len(values))


def _sizes(ends: Sequence[Float]) -> Float:
    """Diagonals of rectangles, to which the sides of their texels are proportional. ``ends``: maxima of -x, -y, x, y."""
    return dr.sqrt(dr.square(ends[0] + ends[2]) + dr.square(ends[1] + ends[3]))


def _mean_size(tiles: Tiles, group: Group, x: Float, y: Float, active: Bool) -> Float:
    """Mean of :func:`_sizes` over the points (x, y), of those parts of a light's tiles that hold points."""
    first, number = group
    tile = tile_of(TileNumbers.of(tiles.by_name(), group), x, y) - first
    counts = _counts(tile, number, active)
    sizes: Float = dr.select(counts > 0, _sizes(_maxima([-x, -y, x, y], tile, number, active)), 0)
    return dr.sum(sizes * counts) / dr.maximum(dr.sum(counts), 1)

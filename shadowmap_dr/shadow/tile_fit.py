"""The fit of tiles to visible points: a k-d tree, kept while it is balanced."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr

from ..jit.arrays import backend
from ..jit.types import Bool, Float, Point3f, UInt32
from .light_camera import Views, of_map, to_light_space
from .tiles import Group, Tiles, tile_of

# Bins of the histogram that finds a median.
_BINS = 32
# Tiles are kept while none has more than the first share of its part of the points, nor less than the second.
_MOST, _LEAST = 1.8, 0.3


def fit_tiles(views: Views, groups: Sequence[Group], seen: tuple[Point3f, Bool], previous: Tiles | None) -> Tiles | None:
    """Tiles of all lights in ``groups``, as many visible points in each, or the previous ones while they are balanced. Detached.

    Args:
        views: cameras of the M maps.
        groups: lights with several tiles, a power of two.
        seen: (points in world space, spread over what cameras see; mask of valid points).
        previous: tiles of an earlier call, None if there are none.

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
            x, y, lit = image_coordinates(views, first, seen[0])
            lit &= module.Bool(seen[1])
            found = _divided(x, y, lit, number)
            if previous is not None:
                kept = previous.rows(dr.arange(module.UInt32, number) + first)
                keep = _balanced(previous, (first, number), x, y, lit)
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
    module = backend(views.spread)
    with dr.suspend_grad():
        view = of_map(dr.detach(views), module.UInt32(first), views.count)
        p = to_light_space(view, dr.detach(module.Array3f(p_world)))
        perspective = view.spread > 0
        before = ~perspective | (p.z > 0)
        w = dr.select(perspective & before, p.z, 1)
        x, y = p.x / w, p.y / w
        return x, y, before & (~perspective | ((dr.abs(x) <= view.spread) & (dr.abs(y) <= view.spread)))


def _divided(x: Float, y: Float, active: Bool, number: int) -> Tiles:
    """A k-d tree's leaves: ``number`` rectangles with as many of the points (x, y) each. Longer sides are halved first."""
    module = backend(x)
    node = dr.zeros(module.UInt32, dr.width(x))
    leaves = Tiles.whole(module, 1)
    nodes = 1
    while nodes < number:
        row = dr.arange(module.UInt32, nodes)
        ends = dr.full(module.Float, -dr.inf, 4 * nodes)
        for k, value in enumerate((-x, -y, x, y)):
            dr.scatter_reduce(dr.ReduceOp.Max, ends, value, node * 4 + k, active)
        low_x, low_y, high_x, high_y = (dr.gather(module.Float, ends, row * 4 + k) for k in range(4))
        wide, high = high_x + low_x, high_y + low_y
        across = wide >= high
        start, length = dr.select(across, -low_x, -low_y), dr.maximum(dr.maximum(wide, high), 1e-30)
        dr.eval(across, start, length)
        along = dr.select(dr.gather(module.Bool, across, node), x, y)
        split = _medians(along, start, length, node, nodes, active)
        child = dr.arange(module.UInt32, 2 * nodes)
        parent, upper = child >> 1, (child & 1) == 1
        dr.eval(split)
        sides, cut = leaves.rows(parent), dr.gather(module.Float, split, parent)
        in_x = dr.gather(module.Bool, across, parent)
        leaves = Tiles(
            dr.select(upper & in_x, cut, sides.low_x),
            dr.select(upper & ~in_x, cut, sides.low_y),
            dr.select(~upper & in_x, cut, sides.high_x),
            dr.select(~upper & ~in_x, cut, sides.high_y),
        )
        dr.eval(leaves)
        node = 2 * node + dr.select(along >= dr.gather(module.Float, split, node), module.UInt32(1), 0)
        nodes *= 2
    return leaves


def _medians(values: Float, start: Float, length: Float, node: UInt32, nodes: int, active: Bool) -> Float:
    """Medians (nodes,) of the values in each node, which lie in ``start`` to ``start + length``. The error is small beside these.

    A histogram finds the bin of the median, a second one the place in the bin: most points may lie in a few bins.
    """
    module = backend(values)
    row = dr.arange(module.UInt32, nodes)
    below = dr.zeros(module.Float, nodes)
    half: Float | None = None
    for _ in range(2):
        place = (values - dr.gather(module.Float, start, node)) / dr.gather(module.Float, length, node) * _BINS
        counts = dr.zeros(module.UInt32, nodes * _BINS)
        inside = active & (place >= 0) & (place <= _BINS)
        bin_ = dr.minimum(module.UInt32(dr.select(inside, place, 0)), _BINS - 1)
        dr.scatter_add(counts, module.UInt32(1), node * _BINS + bin_, inside)
        numbers = [module.Float(dr.gather(module.UInt32, counts, row * _BINS + k)) for k in range(_BINS)]
        half = 0.5 * sum(numbers[1:], numbers[0]) if half is None else half
        passed, found, before, within = below, module.Float(0), below, module.Float(0.5)
        for k, number in enumerate(numbers):
            here = (passed < half) & (passed + number >= half)
            found, before = dr.select(here, float(k), found), dr.select(here, passed, before)
            within = dr.select(here, (half - passed) / dr.maximum(number, 1), within)
            passed = passed + number
        start, length, below = start + length * (found / _BINS), length / _BINS, before
        dr.eval(start, length, below, within, half)
    return start + length * within


def _balanced(tiles: Tiles, group: Group, x: Float, y: Float, active: Bool) -> Bool:
    """True if each tile of a light still has its share of the points."""
    first, number = group
    module = backend(x)
    counts = dr.zeros(module.UInt32, number)
    dr.scatter_add(counts, module.UInt32(1), tile_of(tiles, group, x, y) - first, active)
    total = module.Float(dr.sum(counts))
    shares = module.Float(counts) * number / dr.maximum(total, 1)
    return (dr.max(shares) <= _MOST) & (dr.min(shares) >= _LEAST)

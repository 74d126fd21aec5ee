"""Frusta of the light cameras: fitted to casters and visible receivers, and stable under small changes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import drjit as dr

from ..jit.arrays import backend
from ..jit.kernel_inputs import float_input, quotient, split
from ..jit.types import Bool, Float, Point3f, UInt32
from .grouped import grouped_maxima, numbers_of
from .light_camera import Frusta, Views, of_map, to_light_space
from .tiles import Tiles

#: Bounds in a light's image plane and of depths: (x0, y0, x1, y1, z0, z1).
Extent: TypeAlias = tuple[Float, Float, Float, Float, Float, Float]

# Largest share of a window's area at which a part of it is worth another fit: fits are to stay while little changes.
_MUCH_LESS = 0.05
# Distance of maps from the light, or before the origin of a directional one, where nothing casts and receivers are not known.
_CLOSE, _AWAY = 1e-6, 1e6
# A frustum is kept while it contains the scene and the scene fills at least this fraction of it.
_KEEP_FILL = 0.6
_MARGIN = 0.10
# That of tiles, whose texels are worth more than fits that last.
_MARGIN_OF_TILES = 0.03
# Least depth range of a frustum in units of its lateral extent.
_FLATTEST = 1e-2
# Least depth range, in texels, where visible receivers may shadow themselves: the least deviation of depths, which is a share of
# the range, has to exceed the changes of depth where a surface bends.
_NARROWEST = 64
# That of tiles of suns, in texels: depths are told apart by about one, and the range must tell receivers from casters.
_FLATTEST_OF_TILES = 16
# Least depth range in units of its distance from the light: rounding changes depths by some 1e-7 of the distance.
_THINNEST = 1e-3
# Fraction of the depth range between the last possible caster and the far plane (see `texel_depths`).
_BEHIND_LAST = 0.04
# Distance before the first receiver from which on the map resolves depths, in units of the range behind the first receiver.
_BEFORE = 1.0


@dataclass(frozen=True)
class Bounds:
    """Light-space bounds of each shape in each map: image coordinates and depths.

    ``negated`` holds -x0, -y0, -z0, x1, y1, z1 for each shape in each map: all of them maxima (:func:`grouped_maxima`).
    """

    negated: Float

    def of(self, index: UInt32) -> Extent:
        """(x0, y0, x1, y1, z0, z1) of entry ``map * shapes + shape``."""
        x0, y0, z0, x1, y1, z1 = numbers_of(self.negated, index, 6)
        return -x0, -y0, x1, y1, -z0, z1


def shape_bounds(view: Views, p_light: Point3f, map_index: UInt32, shape_index: UInt32, shape_count: int) -> Bounds:
    """Reduce light-space vertices (one lane for each vertex in each map) to bounds for each shape. Detached."""
    with dr.suspend_grad():
        view, p = dr.detach(view), dr.detach(p_light)
        perspective = of_map(view, map_index, view.count).spread > 0
        behind = perspective & (p.z <= 0)
        w = dr.select(perspective & ~behind, p.z, 1.0)
        x, y = p.x / w, p.y / w
        # With a vertex behind a spot light, a shape may reach anywhere in the image.
        sides = [dr.select(behind, dr.inf, value) for value in (-x, -y, x, y)]
        values = [*sides[:2], -p.z, *sides[2:], p.z]
        # Vertices that are not finite are not drawn.
        drawn = dr.isfinite(p.x + p.y + p.z)
        return Bounds(grouped_maxima(values, map_index * shape_count + shape_index, view.count * shape_count, drawn))


def fit_frusta(
    views: Views,
    bounds: Bounds,
    casts: Bool,
    shape_count: int,
    resolution: int,
    filter_size: int,
    previous: Frusta | None,
    seen: tuple[Point3f, Bool] | None = None,
    receiver_range: bool = True,
    tiles: Tiles | None = None,
    receives: Bool | None = None,
    nearer: tuple[Bool, Bool] | None = None,
) -> Frusta:
    """Frusta that cover all possible casters of visible shadows, or the previous frusta as long as they still do. Detached.

    Args:
        views: cameras of the M maps.
        bounds: from :func:`shape_bounds`.
        casts: mask of the shapes that can cast a shadow in each map (:func:`casting_shapes`). Shapes behind a light never do.
        shape_count: number of shapes.
        resolution: texels along each side of a map.
        filter_size: of the maps' filter, in texels.
        previous: frusta of an earlier call. Kept bit by bit while the casters lie inside them with room for the filter
            and fill most of them.
        seen: (points in world space, spread over the visible receivers; mask of valid points). None: receivers may be anywhere.
        receiver_range: resolve depths only from shortly before the first receiver on, not from the first caster on.
        tiles: parts of the image planes that the maps serve; only visible points inside count for a map.
        nearer: (mask of the maps that serve some of the seen points alone, mask of these points). None: there are no such maps.
        receives: mask of the shapes that can be lit in each map (:func:`receiving_shapes`), None for all of them.

    All arithmetic stays on the device: nothing is read back.
    """
    with dr.suspend_grad():
        views = dr.detach(views)
        module = backend(views.spread)
        index = dr.arange(module.UInt32, views.count * shape_count)
        map_index = quotient(index, "shapes", shape_count)
        extent = bounds.of(index)
        casts &= ~(of_map(views, map_index, views.count).spread > 0) | (extent[5] > 0)
        window = _window(views, seen, tiles)
        if nearer is not None and seen is not None:
            of_some = _window(views, (seen[0], backend(views.spread).Bool(seen[1]) & nearer[1]), tiles)
            window = _chosen(nearer[0], of_some, window)
        if receives is not None:
            window = _around(window, extent, receives, map_index, views.count)
        if not receiver_range:
            window = (*window[:4], module.Float(-dr.inf), window[5])
        fitted = _fit(views, extent, casts, map_index, window, tiles, resolution, filter_size)
        result = fitted[0]
        if previous is not None:
            keep = _still_fits(views, previous, *fitted, resolution, filter_size)
            pairs = zip(previous.columns(), result.columns(), strict=True)
            result = Frusta(*(dr.select(keep, old, new) for old, new in pairs))
        result = replace(result, tiles=tiles)
        dr.eval(result)
        return result


def _window(views: Views, seen: tuple[Point3f, Bool] | None, tiles: Tiles | None) -> Extent:
    """(x0, y0, x1, y1, z0, z1): bounds of the visible points in each map's image plane, within the light's cone, and in depth.

    The window of a tile reaches to its borders, which other points lie on.
    """
    module = backend(views.spread)
    perspective = views.spread > 0
    limit = dr.select(perspective, views.spread, dr.inf)
    if seen is None:
        return -limit, -limit, limit, limit, module.Float(-dr.inf), module.Float(dr.inf)
    points, active = seen
    count = dr.width(points)
    lane = dr.arange(module.UInt32, views.count * count)
    map_index, source = split(lane, "points", count, views.count)
    view = of_map(views, map_index, views.count)
    if views.count > 1:
        points = module.Array3f(*(dr.gather(module.Float, points[c], source) for c in range(3)))
        active = dr.gather(module.Bool, module.Bool(active), source)
    point = module.Array3f(points)
    p = to_light_space(view, point)
    in_perspective = view.spread > 0
    behind = in_perspective & (p.z <= 0)
    w = dr.select(in_perspective & ~behind, p.z, 1)
    if tiles is not None:
        active &= tiles.rows(map_index).hold(p.x / w, p.y / w)
    values = [*(dr.select(behind, dr.inf, v / w) for v in (-p.x, -p.y, p.x, p.y)), -p.z, p.z]
    *sides, nearest, farthest = numbers_of(
        grouped_maxima(values, map_index, views.count, active), dr.arange(module.UInt32, views.count), 6
    )
    if tiles is not None:
        borders = (-tiles.low_x, -tiles.low_y, tiles.high_x, tiles.high_y)
        sides = [dr.select(dr.isfinite(border), border, side) for border, side in zip(borders, sides, strict=True)]
    x0, y0, x1, y1 = (dr.minimum(side, limit) for side in sides)
    return -x0, -y0, x1, y1, -nearest, farthest


def _chosen(mask: Bool, some: Extent, others: Extent) -> Extent:
    """Bounds that are one or the other, map by map."""
    x0, y0, x1, y1, z0, z1 = (dr.select(mask, a, b) for a, b in zip(some, others, strict=True))
    return x0, y0, x1, y1, z0, z1


def _around(window: Extent, extent: Extent, chosen: Bool, map_index: UInt32, count: int) -> Extent:
    """The part of a window around chosen shapes, where that is much less. ``extent``, ``chosen``, ``map_index``: of all shapes in
    all maps."""
    x0, y0, x1, y1, z0, z1 = extent
    bounds = Bounds(grouped_maxima([-x0, -y0, -z0, x1, y1, z1], map_index, count, chosen))
    x0, y0, x1, y1, z0, z1 = bounds.of(dr.arange(type(map_index), count))
    x0, y0, z0 = dr.maximum(x0, window[0]), dr.maximum(y0, window[1]), dr.maximum(z0, window[4])
    x1, y1, z1 = dr.minimum(x1, window[2]), dr.minimum(y1, window[3]), dr.minimum(z1, window[5])
    area = dr.maximum(x1 - x0, 0) * dr.maximum(y1 - y0, 0)
    less = area <= _MUCH_LESS * (window[2] - window[0]) * (window[3] - window[1])
    return _chosen(less, (x0, y0, x1, y1, z0, z1), window)


def _fit(
    views: Views,
    extent: Extent,
    casts: Bool,
    map_index: UInt32,
    window: Extent,
    tiles: Tiles | None,
    resolution: int,
    filter_size: int,
) -> tuple[Frusta, tuple[Float, ...]]:
    module = backend(views.spread)
    x0, y0, x1, y1, z0, z1 = extent
    needed = grouped_maxima([-x0, -y0, -z0, x1, y1, z1], map_index, views.count, casts)
    x0, y0, x1, y1, z0, z1 = Bounds(needed).of(dr.arange(module.UInt32, views.count))
    nothing = ~(x1 >= x0)
    x0, y0, x1, y1 = (dr.select(nothing, s, v) for s, v in ((-1.0, x0), (-1.0, y0), (1.0, x1), (1.0, y1)))

    perspective = views.spread > 0
    x0, y0 = dr.maximum(x0, window[0]), dr.maximum(y0, window[1])
    x1, y1 = dr.minimum(x1, window[2]), dr.minimum(y1, window[3])
    # If no caster lies between the light and visible receivers, maps end before these: whatever else they show is lit.
    nothing |= (x1 < x0) | (y1 < y0)
    before = _before_receivers(perspective, window)
    z0, z1 = dr.select(nothing, before, z0), dr.select(nothing, before, z1)
    # Casters behind all visible receivers do not matter; but visible receivers may end before the first caster.
    z1 = dr.maximum(dr.minimum(z1, window[5]), z0)
    # The distance of casters before all visible receivers does not matter. All casters may lie there.
    receivers = dr.select(dr.isfinite(window[4]) & ~nothing, dr.maximum(window[4], z0), z0)
    # If all casters lie outside of the window, the rectangle is empty; replace it by any small one.
    x1, y1 = dr.maximum(x1, x0 + 1e-4 * (1 + dr.abs(x0))), dr.maximum(y1, y0 + 1e-4 * (1 + dr.abs(y0)))
    # A flat caster that faces the light has no extent in depth. In a tiny range, any tilt would be a huge change of depth, and
    # the derivative of visibility a small difference of huge numbers.
    lateral = dr.maximum(x1 - x0, y1 - y0) * dr.select(perspective, dr.abs(z1), 1)
    flattest = module.Float(_FLATTEST)
    if tiles is not None:
        of_tiles = float_input(module, "flattest", max(_FLATTEST, _FLATTEST_OF_TILES / resolution))
        flattest = dr.select(perspective, flattest, of_tiles)
    least = dr.maximum(flattest * lateral, _THINNEST * dr.maximum(dr.abs(z1), 1e-3))
    # Visible receivers are known from samples only: some may lie a little before these.
    spread = dr.select(dr.isfinite(window[5]) & ~nothing, window[5] - receivers, 0)
    depth = dr.maximum(dr.maximum(z1 - receivers, least), 0.1 * spread)
    near = z0 - 0.05 * dr.maximum(z1 - z0, least)
    # If all casters end before the visible receivers, so does the far plane. If a floor lay right on it, rounding would decide
    # whether the floor is drawn: its depth in the map would have a derivative, but the depth of a receiver, clamped to the far
    # plane, would have none.
    last = dr.maximum(z1, receivers - 0.1 * depth) + 0.05 * depth
    last = dr.select(perspective, dr.maximum(last, 1e-6), last)
    first = dr.maximum(near, receivers - _BEFORE * depth)
    missing = module.Float(0)
    if tiles is None:
        narrowest = lateral * float_input(module, "narrowest", _NARROWEST / resolution)
        missing = dr.select(dr.isfinite(window[4]) & (z1 > window[4]), dr.maximum(narrowest - (last - first), 0), 0)
    far = last + _BEHIND_LAST * (last - first) + 0.5 * missing
    near -= 0.5 * missing
    near = dr.select(perspective, dr.maximum(near, 1e-3 * far), near)
    first = dr.maximum(near, receivers - _BEFORE * depth - 0.5 * missing)

    texels = float_input(module, "texels", 2 * (filter_size / 2 + 2) / resolution)

    def widen(lo: Float, hi: Float, ends: tuple[Float, Float] | None) -> tuple[Float, Float]:
        half, middle = 0.5 * (hi - lo), 0.5 * (lo + hi)
        grown = half * dr.maximum(1 + 2 * (_MARGIN if tiles is None else _MARGIN_OF_TILES), 1 / (1 - texels))
        lo, hi = middle - grown, middle + grown
        if ends is not None:
            # Borders between tiles stay where they are: beyond them, a map needs room for the filter alone.
            room = texels * grown
            lo, hi = dr.maximum(lo, ends[0] - room), dr.minimum(hi, ends[1] + room)
        lo, hi = dr.maximum(lo, -views.limit), dr.minimum(hi, views.limit)
        return 0.5 * (lo + hi), 0.5 * (hi - lo)

    in_x, in_y = (None, None) if tiles is None else ((tiles.low_x, tiles.high_x), (tiles.low_y, tiles.high_y))
    (cx, hx), (cy, hy) = widen(x0, x1, in_x), widen(y0, y1, in_y)
    return Frusta(cx, cy, hx, hy, near, far, first, last), (x0, y0, x1, y1, z0, z1, receivers)


def _before_receivers(perspective: Bool, window: Extent) -> Float:
    """Depth of a place between the light and all visible receivers; close to the light, or far away, if these are not known."""
    nearest, farthest = window[4], window[5]
    least = _THINNEST * dr.maximum(dr.abs(nearest), 1)
    away = dr.maximum(farthest - nearest, least)
    known = dr.select(perspective, 0.5 * nearest, nearest - away)
    return dr.select(dr.isfinite(nearest), known, dr.select(perspective, _CLOSE, -_AWAY))


def _still_fits(views: Views, old: Frusta, new: Frusta, needed: tuple[Float, ...], resolution: int, filter_size: int) -> Bool:
    x0, y0, x1, y1, z0, z1, receivers = needed
    room = float_input(backend(views.spread), "texels", 2 * (filter_size / 2 + 1) / resolution)

    def holds(lo: Float, hi: Float, center: Float, half: Float) -> Bool:
        # A map that reaches its limit needs no margin there.
        limit = views.limit * (1 - 1e-5)
        below = (lo >= center - half * (1 - room)) | (center - half <= -limit)
        return below & ((hi <= center + half * (1 - room)) | (center + half >= limit))

    keep = holds(x0, x1, old.center_x, old.half_x) & holds(y0, y1, old.center_y, old.half_y)
    keep &= (new.half_x >= _KEEP_FILL * old.half_x) & (new.half_y >= _KEEP_FILL * old.half_y)
    # If casters surround a light, its near plane follows from the far plane alone, and need not follow it closely.
    around = (views.spread > 0) & (z0 < new.near)
    keep &= dr.maximum(z0, new.near) >= dr.select(around, 0.5 * old.near, old.near)
    # Receivers before the resolved depth range would lose their shadows.
    keep &= dr.maximum(receivers, new.first) >= dr.select(around & (old.first <= old.near), 0.5 * old.first, old.first)
    keep &= z1 <= old.last
    keep &= new.far - new.first >= _KEEP_FILL * (old.far - old.first)
    return keep

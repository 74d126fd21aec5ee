"""Step 3 of a shadow map: visibility of points from the light."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import drjit as dr
import numpy as np

from ..jit.arrays import backend
from ..jit.branches import branch
from ..jit.broadcast import copies_for_threads, copy_of_lane
from ..jit.kernel_inputs import float_input, int_input, uint_input
from ..jit.types import AnyArray, Bool, Float, Point3f, UInt32
from .filters import filter_kernel, separable_terms
from .light_camera import Frusta, Views, of_map, of_tile, project, tile_numbers, to_light_space
from .methods.comparison import soft_comparison, standard_visibility
from .methods.depth_scale import DepthScale
from .methods.registry import PREFILTERED
from .methods.variance import MINIMUM_VARIANCE_COMPAT, chebyshev_visibility, reduced_bleeding
from .settings import ShadowSettings
from .shadow_map import ShadowMaps
from .texel_depths import FAR, depth_scale
from .tile_fit import image_coordinates
from .tiles import Group, TileNumbers, neighbour, tile_of
from .transmittance_maps import TransmittanceMaps, depth_encoding

# Depth range over which the comparison of percentage-closer filtering falls from 1 to 0. A hard one has no derivative by depth.
_SOFTNESS = 0.02
# Visibility that is cut off at both ends in maps of tiles without a filter. Coverage of a texel and bilinear interpolation blur
# an edge over two texels, which are somewhat smaller than pixels: it takes two thirds of a pixel then.
_ENDS = 0.2
# Weight from which on a texel's distribution counts.
_NOTHING = 1e-9
# Most texels along a border of a map that are not looked up, both sides together, and share of a light's limit that is its end.
_RING, _LIMIT = 4, 1 - 1e-4


def visibility(maps: ShadowMaps, map_index: UInt32 | int, p_world: Point3f, active: Bool | bool = True) -> Float:
    """Step 3: fraction of the light that reaches world-space points.

    Args:
        maps: filtered maps.
        map_index: index of the map, for each point or one for all.
        p_world: points. Attached.
        active: mask of the points to look up; the others get 1.

    Returns:
        ``Float`` in 0..1; 1 outside the map (0 with ``compat``). Gradients flow to the points, the casters and the light.
    """
    return _visibility(maps, _place_in_map(maps, map_index, p_world), p_world, active)


def _visibility(maps: ShadowMaps, place: _Place, p_world: Point3f, active: Bool | bool) -> Float:
    """:func:`visibility` of points at known places in the maps."""
    if maps.settings.compat:
        p = to_light_space(place.view, p_world)
        inside = place.inside & active
        return dr.select(active, _look_up_compat(maps, place.index, place.u, place.v, dr.norm(p), inside), 1)
    inside = place.inside & backend(maps.values).Bool(active)
    lanes: list[AnyArray] = [place.index, place.u, place.v, place.depth]
    compare = {"standard": _compare, "pcf": _compare_all}.get(maps.settings.method)
    if compare is not None:
        return _where(inside, compare, maps, *lanes)
    lanes += [backend(maps.values).Float(number) for number in (place.scale.deviation, place.scale.exponent)]
    return _where(inside, _resolve, maps, *lanes)


@dataclass(frozen=True)
class _Place:
    """Places of points in maps.

    Attributes:
        view: cameras of the maps.
        index: of the map among all copies of the maps.
        u, v, depth: in -1..1, and linear depth. Attached.
        inside: whether a point lies in the map.
        scale: on which the map tells depths apart. Detached.
    """

    view: Views
    index: UInt32
    u: Float
    v: Float
    depth: Float
    inside: Bool
    scale: DepthScale


def _place_in_map(maps: ShadowMaps, map_index: UInt32 | int, p_world: Point3f, numbers: TileNumbers | None = None) -> _Place:
    """Places of points in the maps with an index, for each point or one for all. ``numbers``: of the light, if the maps are its
    tiles and its camera carries no gradient."""
    module = backend(maps.values)
    row: UInt32 = module.UInt32(map_index)
    index = row
    if maps.copies > 1:
        index = row + copy_of_lane(module, dr.width(p_world), maps.copies) * maps.count
    if numbers is None:
        view, frustum = of_map(maps.views, index, maps.views.count), of_map(maps.frusta, row, maps.count)
    else:
        view, frustum = of_tile(numbers, maps.views, row)
    u, v, depth, inside = project(view, frustum, p_world)
    if not maps.settings.compat:
        inside &= has_neighbours(maps.settings, view, frustum, u, v)
    scale = depth_scale(view, frustum, depth, maps.settings, maps.frusta.tiles is not None)
    return _Place(view, index, u, v, dr.select(depth > FAR, FAR, depth), inside, scale)


def has_neighbours(settings: ShadowSettings, view: Views, frustum: Frusta, u: Float, v: Float) -> Bool:
    """Mask of points so far from a map's border that a filter of three texels and interpolation read no replicated ones.

    Depths of surfaces that a light strikes at a slant are wrong there. No shadow reaches that far, not even a filtered one, but
    at borders where a light ends, or a face of a cube.
    """
    texels = min(settings.filter_size + 1, _RING)
    module = backend(u)
    ring = float_input(module, "ring", texels / settings.resolution)
    found = module.Bool(True)
    for place, centre, half in ((u, frustum.center_x, frustum.half_x), (v, frustum.center_y, frustum.half_y)):
        ends = dr.abs(centre) + half >= _LIMIT * view.limit
        found &= ends | (dr.abs(dr.detach(place)) <= 1 - ring)
    return found


def tiled_visibility(maps: ShadowMaps, group: Group, p_world: Point3f, active: Bool | bool = True) -> Float:
    """Visibility as of :func:`visibility` from the tiles of a light; along borders a mean of both tiles.

    Values of maps without a filter are sharpened: an edge is narrower than two texels. Gradients are those of the blurred edge,
    which sum up to the same, and which more pixels sample.

    Args:
        maps: filtered maps.
        group: maps of the light.
        p_world: points. Attached. The share of each tile is detached.
        active: mask of the points to look up; the others get 1.
    """
    at = _Tiled.of(maps, group, p_world)
    own = _visibility(maps, at.place(maps, at.tile, p_world), p_world, active)
    beside = _visibility(maps, at.place(maps, at.other, p_world), p_world, active & (at.share > 0))
    found = dr.fma(at.share, beside - own, own)
    return found if maps.settings.filters else _sharpened(found)


def _sharpened(visibility: Float) -> Float:
    """Visibility with both ends cut off, and the rest stretched to 0..1; with the gradient of the visibility itself."""
    with_gradient = cast("Callable[[Float, Float], Float]", dr.replace_grad)  # None in the stub
    return with_gradient(dr.clip((dr.detach(visibility) - _ENDS) * (1 / (1 - 2 * _ENDS)), 0, 1), visibility)


@dataclass(frozen=True)
class _Tiled:
    """Tiles of a light in which points lie: ``tile``, and beyond the nearest border ``other``, which has a ``share``.

    ``numbers``: as of :func:`_place_in_map`.
    """

    tile: UInt32
    other: UInt32
    share: Float
    numbers: TileNumbers | None

    @classmethod
    def of(cls, maps: ShadowMaps, group: Group, p_world: Point3f) -> _Tiled:
        numbers = tile_numbers(maps.views, maps.frusta, group, maps.tile_rows)
        x, y, _ = image_coordinates(maps.views, group[0], p_world)
        tile = tile_of(numbers, x, y)
        other, share = neighbour(numbers, tile, x, y)
        if numbers.rows is not None:
            return cls(tile, other, share, numbers)
        if not dr.flag(dr.JitFlag.SymbolicScope):
            dr.eval(tile, other, share)  # otherwise each pass would find them again
        return cls(tile, other, share, None)

    def place(self, maps: ShadowMaps, tile: UInt32, p_world: Point3f) -> _Place:
        """Places of the points in one of their tiles."""
        return _place_in_map(maps, tile, p_world, self.numbers)


def transmittance(maps: ShadowMaps, map_index: UInt32 | int, p_world: Point3f, active: Bool | bool = True) -> list[Float]:
    """Fraction of the light, by colour, that translucent casters let through to world-space points.

    Args:
        maps: filtered maps with translucent casters.
        map_index: index of the map, for each point or one for all.
        p_world: points. Attached.
        active: mask of the points to look up; the others get 1.

    Returns:
        ``Float`` in 0..1 for each colour; 1 outside the map. Gradients flow to the points, the casters and the light.
    """
    stored = maps.transmittance
    assert stored is not None, "looked up only where there are translucent casters"
    return _transmittance(maps, stored, _place_in_map(maps, map_index, p_world), active)


def _transmittance(maps: ShadowMaps, stored: TransmittanceMaps, place: _Place, active: Bool | bool) -> list[Float]:
    """:func:`transmittance` of points at known places in the maps."""
    found = branch(
        place.inside & backend(maps.values).Bool(active),
        lambda *lanes: _light_left(maps, stored, *lanes),
        lambda *lanes: tuple(type(lanes[1])(1) for _ in range(stored.colours)),
        (place.index, place.u, place.v, place.depth, place.scale.deviation),
        "transmittance",
    )
    return list(found)


def tiled_transmittance(maps: ShadowMaps, group: Group, p_world: Point3f, active: Bool | bool = True) -> list[Float]:
    """As :func:`transmittance`, from the tiles of a light, as :func:`tiled_visibility`."""
    stored = maps.transmittance
    assert stored is not None, "looked up only where there are translucent casters"
    at = _Tiled.of(maps, group, p_world)
    own = _transmittance(maps, stored, at.place(maps, at.tile, p_world), active)
    beside = _transmittance(maps, stored, at.place(maps, at.other, p_world), active & (at.share > 0))
    return [dr.fma(at.share, b - a, a) for a, b in zip(own, beside, strict=True)]


def _light_left(
    maps: ShadowMaps, stored: TransmittanceMaps, map_index: UInt32, u: Float, v: Float, depth: Float, deviation: Float
) -> tuple[Float, ...]:
    """Light of each colour that is left at a depth."""
    method, module = depth_encoding(maps.settings), backend(depth)
    left = [module.Float(1)] * stored.colours
    scale = DepthScale(deviation)
    used = stored.colours + 1 + len(method.encode(depth, 0.0, maps.settings.order, scale))
    for group in range(stored.groups):
        first = group * stored.channels
        values = bilinear(maps, map_index, u, v, True, values=(stored.values, stored.groups * stored.channels, first, used))
        weight = values[stored.colours]
        any_lost = weight > _NOTHING
        inverse = dr.rcp(dr.select(any_lost, weight, 1))
        moments = [value * inverse for value in values[stored.colours + 1 :]]
        lit = method.resolve(moments, depth, scale)
        if method.bleeds:
            lit = reduced_bleeding(lit, maps.settings.bleeding)
        before = dr.select(any_lost, 1 - lit, 0)
        left = [dr.fma(-values[k], before, value) for k, value in enumerate(left)]
    return tuple(dr.clip(value, 0, 1) for value in left)


def _where(active: Bool, function: Callable[..., Float], maps: ShadowMaps, *lanes: AnyArray) -> Float:
    """``function(maps, *lanes)`` where ``active``, 1 elsewhere. A branch, for maps cover the casters, not all visible points."""
    found: Float = branch(
        active, lambda *lanes: function(maps, *lanes), lambda *lanes: type(lanes[1])(1), lanes, "shadow look-up"
    )
    return found


def _resolve(maps: ShadowMaps, map_index: UInt32, u: Float, v: Float, depth: Float, deviation: Float, exponent: Float) -> Float:
    """Visibility from filtered moments or terms."""
    method = PREFILTERED[maps.settings.method]
    value = method.resolve(bilinear(maps, map_index, u, v, True), depth, DepthScale(deviation, exponent))
    return reduced_bleeding(value, maps.settings.bleeding) if method.bleeds else value


def _compare(maps: ShadowMaps, map_index: UInt32, u: Float, v: Float, depth: Float) -> Float:
    """One comparison with the nearest texel."""
    module = backend(maps.values)
    size = maps.settings.resolution
    texels, last = uint_input(module, "texels", size), float_input(module, "texels", size - 1)
    column, row = (module.UInt32(dr.clip((x * 0.5 + 0.5) * texels, 0, last)) for x in (u, v))
    stored = dr.gather(module.Float, maps.values, (map_index * texels + row) * texels + column)
    return standard_visibility(stored, depth, maps.settings.bias)


def _compare_all(maps: ShadowMaps, map_index: UInt32, u: Float, v: Float, depth: Float) -> Float:
    """Weighted comparisons with all texels under the filter, which moves continuously with the point. Attached to both.

    Source: Reeves et al., "Rendering Antialiased Shadows with Depth Maps", 1987.
    """
    module = backend(maps.values)
    s = maps.settings
    at = Texels(s.resolution, map_index, u, v)
    total = module.Float(0)
    for column, row in separable_terms(filter_kernel(s.filter, s.filter_size)):
        radius = len(row) // 2
        across, down = moved_weights(row, at.fx), moved_weights(column, at.fy)
        for j, weight_down in enumerate(down):
            line = module.Float(0)
            for i, weight in enumerate(across):
                line = dr.fma(weight, _compare_texel(maps, at.index(i - radius, j - radius), depth), line)
            total = dr.fma(weight_down, line, total)
    return dr.clip(total, 0, 1)


def _compare_texel(maps: ShadowMaps, texel: UInt32, depth: Float) -> Float:
    """Fraction of a texel that is lit at a depth."""
    bias = maps.settings.bias
    if maps.channels == 1:
        stored = dr.gather(backend(maps.values).Float, maps.values, texel)
        return soft_comparison(stored, depth, bias, _SOFTNESS)
    centre, other, share, _ = dr.gather(backend(maps.values).Array4f, maps.values, texel)
    lit = soft_comparison(centre, depth, bias, _SOFTNESS)
    return dr.fma(share, soft_comparison(other, depth, bias, _SOFTNESS) - lit, lit)


def moved_weights(weights: list[float], fraction: Float) -> list[Float]:
    """Weights of a line of taps after a shift by a fraction of a texel; one more than before. Attached to the fraction."""
    padded = np.array([0.0, *weights, 0.0])
    return [dr.fma(fraction, float(a - b), float(b)) for a, b in zip(padded[:-1], padded[1:], strict=True)]


class Texels:
    """The texels around points (u, v in -1..1). Texel centres lie at + 1/2."""

    def __init__(self, size: int, map_index: UInt32, u: Float, v: Float, active: Bool | bool = True) -> None:
        """``size``: texels along each side."""
        module = backend(u)
        self.size = int_input(module, "texels", size)
        half, middle = float_input(module, "texels", 0.5 * size), float_input(module, "texels", 0.5 * size - 0.5)
        x, y = (dr.select(active, dr.fma(place, half, middle), 0) for place in (u, v))
        x0, y0 = dr.floor(dr.detach(x)), dr.floor(dr.detach(y))
        self.fx, self.fy = x - x0, y - y0
        self.column, self.row = module.Int32(x0), module.Int32(y0)
        self.base = module.Int32(map_index) * (self.size * self.size)

    def index(self, i: int, j: int) -> UInt32:
        """Index of the texel i columns and j rows from the upper left neighbour; the border is replicated."""
        c, r = (dr.clip(x, 0, self.size - 1) for x in (self.column + i, self.row + j))
        return backend(c).UInt32(self.base + r * self.size + c)

    def inside(self, i: int, j: int) -> Bool:
        c, r = self.column + i, self.row + j
        return (c >= 0) & (c < self.size) & (r >= 0) & (r < self.size)


def bilinear(
    maps: ShadowMaps,
    map_index: UInt32,
    u: Float,
    v: Float,
    active: Bool | bool,
    outside_reads_zero: bool = False,
    values: tuple[Float, int, int, int] | None = None,
) -> list[Float]:
    """Bilinear interpolation of the four texels around (u, v). Attached to the texels and to the coordinates.

    ``values``: numbers that are read instead of the maps' own, how many of them a texel has, the first of these that is read, and
    how many are.
    """
    size = (maps.settings if values is None else maps.settings.of_transmittance).resolution
    at = Texels(size, map_index, u, v, active)
    stored, channels, first, used = values or (maps.values, maps.channels, 0, maps.channels)
    mode, rows = copies_for_threads(stored), []
    for j in range(2):
        use = [active & at.inside(i, j) if outside_reads_zero else active for i in range(2)]
        left, right = (stored_texel(stored, channels, at.index(i, j), use[i], (first, used), mode) for i in range(2))
        rows.append([dr.fma(b - a, at.fx, a) for a, b in zip(left, right, strict=True)])
    return [value for a, b in zip(*rows, strict=True) for value in entries(dr.fma(b - a, at.fy, a))]


def stored_texel(
    values: Float,
    channels: int,
    texel: UInt32,
    active: Bool | bool,
    used: tuple[int, int] | None = None,
    mode: dr.ReduceMode = dr.ReduceMode.Auto,
) -> list[AnyArray]:
    """Numbers of a texel, in the largest packets that divide ``channels``. ``mode``: of adjoints.

    ``used``: the first of the numbers, a multiple of the packets' size, and how many are read; None for all.

    No more than that: Dr.Jit 1.5 ends the process in forward mode where a symbolic branch leaves a part of a packet unused.
    """
    module = backend(values)
    packets = {1: module.Float, 2: module.Array2f, 4: module.Array4f}
    found: list[AnyArray] = []
    first, count = used or (0, channels)
    last = first + count
    while first < last:
        size = next(n for n in (4, 2, 1) if channels % n == 0 and first % n == 0 and n <= last - first)
        found.append(dr.gather(packets[size], values, texel * (channels // size) + first // size, active, mode=mode))
        first += size
    return found


def entries(packet: AnyArray) -> list[Float]:
    return list(packet) if dr.depth_v(packet) > 1 else [cast("Float", packet)]


def _look_up_compat(maps: ShadowMaps, map_index: UInt32, u: Float, v: Float, depth: Float, active: Bool) -> Float:
    moments = bilinear(maps, map_index, dr.select(active, u, 0), dr.select(active, v, 0), active, outside_reads_zero=True)
    return chebyshev_visibility(backend(depth).Array2f(*moments), depth, MINIMUM_VARIANCE_COMPAT)

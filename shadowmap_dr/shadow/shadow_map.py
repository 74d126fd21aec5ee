"""Shadow maps in three steps: render maps, filter maps, compute visibility."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from ..raster import RasterOutput, Topology, antialias, visible_triangles
from ..raster._types import backend, pixel_coordinates
from ..raster.planes import pixel_depth
from .camera import Frusta, Views, linear_depth, of_map, project, to_clip, to_light_space
from .filters import FILTERS, filter_kernel, filter_map
from .moments import (
    METHODS,
    MINIMUM_VARIANCE,
    MINIMUM_VARIANCE_COMPAT,
    chebyshev_visibility,
    standard_visibility,
    variance_moments,
)

# Depth that a texel without geometry holds, and beyond which receivers are moved to it: an unoccluded receiver lies at its mean.
_FAR = 0.5
# A plane's slope counts as variance up to this many texels of depth per texel; silhouettes seen edge-on would have any amount.
_MAX_SLOPE = 2.0


@dataclass(frozen=True)
class ShadowSettings:
    """How shadows are computed.

    Attributes:
        method: ``vsm`` (variance shadow map), ``standard`` (depth comparison, no gradients) or ``none``.
        resolution: texels along each side of a map.
        filter: ``box``, ``gaussian``, ``wendland`` or ``none``.
        filter_size: odd number of texels.
        antialias: anti-alias the maps; without it shadows have no gradient to the outlines of their casters.
        bias: depth offset of ``standard``, in units of the depth range of the map.
        compat: the conventions of Worchel and Alexa's code: unnormalised radial depth, fixed frusta, dark outside of them, their
            kernels, minimum variance 1e-4.
    """

    method: str = "vsm"
    resolution: int = 256
    filter: str = "gaussian"
    filter_size: int = 3
    antialias: bool = True
    bias: float = 5e-3
    compat: bool = False

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise ValueError(f"shadow method {self.method!r} is unknown; choose one of {', '.join(METHODS)}")
        if self.filter not in FILTERS:
            raise ValueError(f"shadow filter {self.filter!r} is unknown; choose one of {', '.join(FILTERS)}")
        if not 1 <= self.resolution <= 4096:
            raise ValueError(f"shadow map resolution is {self.resolution}; it must lie between 1 and 4096")
        filter_kernel(self.filter, self.filter_size)
        if self.filter_size + 6 > self.resolution and self.method != "none":
            raise ValueError(
                f"shadow filter size {self.filter_size} is too large for maps of {self.resolution} texels; "
                f"use at least {self.filter_size + 6} texels"
            )


@dataclass(frozen=True)
class ShadowMaps:
    """A batch of M square maps.

    Attributes:
        values: flat ``Float`` (M * N * N * C): moments (C = 2), or depths for the standard method (C = 1). Attached.
        views, frusta: cameras of the maps.
        settings: how they were made.
        channels: C.
    """

    values: Any
    views: Views
    frusta: Frusta
    settings: ShadowSettings
    channels: int


def render_maps(
    p_light: Any,
    map_index: Any,
    faces: Any,
    topology: Topology,
    views: Views,
    frusta: Frusta,
    settings: ShadowSettings,
    transparent: Callable[[RasterOutput], Any] | None = None,
) -> ShadowMaps:
    """Step 1: rasterize all maps at once and store what the method needs of the depths in each texel.

    Args:
        p_light: ``Array3f`` of width M * V, vertices in each map's light space (:func:`to_light_space`). Attached.
        map_index: ``UInt32``, the map of each lane of ``p_light``.
        faces: flat ``UInt32`` (3 F,), valid indices.
        topology: of the mesh.
        views, frusta: cameras of the M maps.
        transparent: alpha test, see :func:`shadowmap_dr.raster.rasterize`.
    """
    count, size = views.count, settings.resolution
    clip = to_clip(of_map(views, map_index, count), of_map(frusta, map_index, count), p_light)
    clip = dr.ravel(clip)
    dr.eval(clip)
    raster = visible_triangles(clip, faces, (size, size), batch=count, transparent=transparent)
    values, channels = _texels(raster, clip, faces, views, frusta, settings)
    if settings.antialias and settings.method != "standard":
        dr.eval(values)
        values = antialias(values, raster, clip, topology)
    return ShadowMaps(values, views, frusta, settings, channels)


def _texels(
    raster: RasterOutput, clip: Any, faces: Any, views: Views, frusta: Frusta, settings: ShadowSettings
) -> tuple[Any, int]:
    module = backend(raster.triangle)
    size = settings.resolution
    image, row, column = pixel_coordinates(module, views.count, size, size)
    view, frustum = of_map(views, image, views.count), of_map(frusta, image, views.count)
    hit = raster.valid
    if settings.compat:
        depth = _radial_depth(view, frustum, raster, row, column, size)
        depth, slope_square = dr.select(hit, depth, frustum.far), 0
    else:
        ndc, dx, dy = pixel_depth(raster, clip, faces)
        linear, to_linear = linear_depth(view, frustum, ndc)
        depth = dr.select(hit, linear, _FAR)
        with dr.suspend_grad():
            slopes = [dr.detach(to_linear * slope) for slope in (dx, dy)]
            slope_square = dr.select(hit, _slope_square(dr.detach(view), dr.detach(frustum), dr.detach(linear), slopes, size), 0)
    if settings.method == "standard":
        return depth, 1
    return dr.ravel(variance_moments(depth, slope_square)), 2


def _radial_depth(view: Views, frustum: Frusta, raster: RasterOutput, row: Any, column: Any, size: int) -> Any:
    """Distance from the light camera's origin to what a texel sees."""
    module = backend(raster.triangle)
    perspective = view.spread > 0
    z = dr.select(perspective, raster.w, dr.fma(0.5 * raster.depth + 0.5, frustum.far - frustum.near, frustum.near))
    scale = dr.select(perspective, z, 1.0)
    x = dr.fma((2 * module.Float(column) + (1 - size)) / size, frustum.half_x, frustum.center_x) * scale
    y = dr.fma((2 * module.Float(row) + (1 - size)) / size, frustum.half_y, frustum.center_y) * scale
    return dr.sqrt(dr.fma(x, x, dr.fma(y, y, z * z)))


def _slope_square(view: Views, frustum: Frusta, linear: Any, slopes: list[Any], size: int) -> Any:
    """Squared change of linear depth across a texel, given its change along both axes."""
    n, f = frustum.near, frustum.far
    # The side of a texel in units of depth.
    texel = dr.select(view.spread > 0, dr.fma(linear + 0.5, f - n, n), 1.0) * (2 / size) / (f - n)
    sx = dr.minimum(dr.abs(slopes[0]), _MAX_SLOPE * texel * frustum.half_x)
    sy = dr.minimum(dr.abs(slopes[1]), _MAX_SLOPE * texel * frustum.half_y)
    return sx * sx + sy * sy


def filter_maps(maps: ShadowMaps) -> ShadowMaps:
    """Step 2: pre-filter. Depths of the standard method cannot be filtered and pass unchanged."""
    s = maps.settings
    if s.method == "standard":
        return maps
    kernel = filter_kernel(s.filter, s.filter_size, s.compat)
    values = filter_map(maps.values, kernel, maps.views.count, s.resolution, s.resolution, maps.channels)
    return ShadowMaps(values, maps.views, maps.frusta, s, maps.channels)


def visibility(maps: ShadowMaps, map_index: Any, p_world: Any, active: Any = True) -> Any:
    """Step 3: fraction of the light that reaches world-space points.

    Args:
        maps: filtered maps.
        map_index: which map to ask, ``UInt32`` for each point or one number.
        p_world: ``Array3f``. Attached.
        active: points to ask for; the others get 1.

    Returns:
        ``Float`` in 0..1; 1 outside the map (0 with ``compat``). Gradients flow to the points, the casters and the light.
    """
    module = backend(maps.values)
    count = maps.views.count
    map_index = module.UInt32(map_index)
    view, frustum = of_map(maps.views, map_index, count), of_map(maps.frusta, map_index, count)
    u, v, depth, inside = project(view, frustum, p_world)
    if maps.settings.compat:
        p = to_light_space(view, p_world)
        return dr.select(active, _look_up_compat(maps, map_index, u, v, dr.norm(p), inside & active), 1)
    inside &= module.Bool(active)
    depth = dr.select(depth > _FAR, _FAR, depth)
    if maps.settings.method == "standard":
        size = maps.settings.resolution
        column = module.UInt32(dr.clip((u * 0.5 + 0.5) * size, 0, size - 1))
        row = module.UInt32(dr.clip((v * 0.5 + 0.5) * size, 0, size - 1))
        stored = dr.gather(module.Float, maps.values, (map_index * size + row) * size + column, inside)
        return dr.select(inside, standard_visibility(stored, depth, maps.settings.bias), 1)
    return _where(inside, _look_up, maps, map_index, u, v, depth)


def _where(active: Any, function: Callable[..., Any], maps: ShadowMaps, *lanes: Any) -> Any:
    """``function(maps, *lanes)`` where there are active lanes, 1 elsewhere: maps cover the casters, not all that is seen."""
    return dr.if_stmt(
        lanes,
        active,
        lambda *lanes: function(maps, *lanes),
        lambda *lanes: type(lanes[1])(1),
        mode="symbolic",
        label="shadow look-up",
    )


def _look_up(maps: ShadowMaps, map_index: Any, u: Any, v: Any, depth: Any) -> Any:
    moments = _bilinear(maps, map_index, u, v, True)
    return chebyshev_visibility(moments, depth, MINIMUM_VARIANCE)


def _bilinear(maps: ShadowMaps, map_index: Any, u: Any, v: Any, active: Any, outside_reads_zero: bool = False) -> Any:
    """Moments at (u, v) in -1..1, between texel centres at + 1/2; attached to the moments and to the coordinates."""
    module = backend(maps.values)
    size = maps.settings.resolution
    x = dr.select(active, dr.fma(u, 0.5 * size, 0.5 * size - 0.5), 0)
    y = dr.select(active, dr.fma(v, 0.5 * size, 0.5 * size - 0.5), 0)
    x0, y0 = dr.floor(dr.detach(x)), dr.floor(dr.detach(y))
    fx, fy = x - x0, y - y0
    column, row = module.Int32(x0), module.Int32(y0)
    base = module.Int32(map_index) * (size * size)
    packet = {2: module.Array2f, 4: module.Array4f}[maps.channels]
    rows = []
    for j in range(2):
        ends = []
        for i in range(2):
            c, r = column + i, row + j
            use = active & (c >= 0) & (c < size) & (r >= 0) & (r < size) if outside_reads_zero else active
            index = base + dr.clip(r, 0, size - 1) * size + dr.clip(c, 0, size - 1)
            ends.append(dr.gather(packet, maps.values, module.UInt32(index), use))
        rows.append(dr.fma(ends[1] - ends[0], fx, ends[0]))
    return dr.fma(rows[1] - rows[0], fy, rows[0])


def _look_up_compat(maps: ShadowMaps, map_index: Any, u: Any, v: Any, depth: Any, active: Any) -> Any:
    moments = _bilinear(maps, map_index, dr.select(active, u, 0), dr.select(active, v, 0), active, outside_reads_zero=True)
    return chebyshev_visibility(moments, depth, MINIMUM_VARIANCE_COMPAT)

"""Shadow maps in three steps: render maps, filter maps, compute visibility."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr

from ..jit.arrays import backend, interleave, ravel
from ..jit.broadcast import in_copies
from ..jit.handover import interleaved
from ..jit.kernel_inputs import float_input, quotient, uint_input
from ..jit.types import Bool, Float, Point3f, UInt32
from ..raster import RasterOutput, Topology, antialias, visible_triangles
from ..raster.screen_planes import pixel_depth
from ..raster.types import pixel_coordinates
from .filters import filter_kernel, filter_map, reach_of
from .light_camera import Frusta, Views, linear_depth, of_map, to_clip
from .methods.comparison import other_depth
from .methods.registry import PREFILTERED
from .methods.variance import variance_moments
from .settings import ShadowSettings

#: Depth of empty texels. Receivers behind it are moved to it, so that a receiver over empty texels lies at their mean.
FAR = 0.5
# Largest slope that counts as variance, in texels of depth per texel. Surfaces seen edge-on have unbounded slopes.
_MAX_SLOPE = 2.0


@dataclass(frozen=True)
class ShadowMaps:
    """A batch of M square maps.

    Attributes:
        values: (M * N * N * C,), flat: numbers that the method stores in each texel, such as two moments of depth. Attached.
        views, frusta: cameras of the maps.
        settings: settings of the maps.
        channels: C.
        copies: number of consecutive copies of values and views, one for each block of points (:meth:`for_points`).
    """

    values: Float
    views: Views
    frusta: Frusta
    settings: ShadowSettings
    channels: int
    copies: int = 1

    @property
    def count(self) -> int:
        """Number of maps M."""
        return self.views.count // self.copies

    def for_points(self, count: int) -> ShadowMaps:
        """The same maps, copied for look-ups by ``count`` points at once, so that gradients are summed exactly. Attached."""
        (values, *columns), copies = in_copies([self.values, *self.views.columns()], count)
        return replace(self, values=values, views=Views.of(columns), copies=copies) if copies > 1 else self


def render_maps(
    p_light: Point3f,
    map_index: UInt32,
    faces: UInt32,
    topology: Topology,
    views: Views,
    frusta: Frusta,
    settings: ShadowSettings,
    transparent: Callable[[RasterOutput], Bool] | None = None,
    culled: Bool | None = None,
) -> ShadowMaps:
    """Step 1: rasterize all maps at once and encode the depths in each texel by the method. Attached to ``p_light``.

    Args:
        p_light: (M * V,) vertices in each map's light space (:func:`to_light_space`). Attached.
        map_index: map of each lane of ``p_light``.
        faces: (3 F,), flat, valid indices.
        topology: topology of the mesh.
        views, frusta: cameras of the M maps.
        transparent: alpha test, see :func:`shadowmap_dr.raster.rasterize`.
        culled: (F,), or (M F,) by map: faces that are not drawn where they face away from the light.
    """
    count, size = views.count, settings.resolution * settings.supersampling
    in_maps = to_clip(of_map(views, map_index, count), of_map(frusta, map_index, count), p_light)
    clip = interleaved("positions in maps", list(in_maps))
    # Seen from the front, outlines run clockwise: a light looks along the third of its right-handed axes.
    raster = visible_triangles(clip, faces, (size, size), batch=count, transparent=transparent, one_sided=culled)
    texels = _texels(raster, clip, faces, views, frusta, settings, size)
    channels = len(texels)
    if settings.antialias and settings.method != "standard":
        values = interleaved("texels", texels)
        blended = antialias(values, raster, clip, topology)
        values, channels = _two_depths(values, blended) if settings.method == "pcf" else (blended, channels)
    else:
        values = interleave(texels)
    if settings.supersampling > 1:
        values = block_means(values, size, channels, settings.supersampling)
    return ShadowMaps(values, views, frusta, settings, channels)


def _texels(
    raster: RasterOutput, clip: Float, faces: UInt32, views: Views, frusta: Frusta, settings: ShadowSettings, size: int
) -> list[Float]:
    """Channels of the texels, for maps of ``size`` texels along each side."""
    module = backend(raster.triangle)
    image, row, column = pixel_coordinates(module, views.count, size, size)
    view, frustum = of_map(views, image, views.count), of_map(frusta, image, views.count)
    hit = raster.valid
    slope_square: Float | float = 0
    if settings.compat:
        depth = _radial_depth(view, frustum, raster, row, column, size)
        depth = dr.select(hit, depth, frustum.far)
    else:
        seen = pixel_depth(raster, clip, faces, dr.detach(views.spread) > 0)
        texels = texel_depths(seen, hit, view, frustum, settings)
        depth, slope_square = texels.depth, texels.slope_square
    method = PREFILTERED.get(settings.method)
    if method is None:
        if settings.method == "pcf" and settings.antialias:
            return list(variance_moments(depth))
        return [depth]
    return list(method.encode(depth, slope_square, settings.order))


@dataclass(frozen=True)
class TexelDepths:
    """Depths of the surfaces that texels see, one lane for each texel.

    Attributes:
        shown: mask of the texels that see a surface whose depth is kept.
        depth: linear depth (:func:`linear_depth`), ``FAR`` in other texels. Attached.
        slope_square: squared change of the linear depth across a texel, detached.
        seen, dx, dy: depth as :func:`pixel_depth` returns it (attached), and its change by column and by row (detached).
    """

    shown: Bool
    depth: Float
    slope_square: Float
    seen: Float
    dx: Float
    dy: Float


def texel_depths(
    seen: tuple[Float, Float, Float], hit: Bool, view: Views, frustum: Frusta, settings: ShadowSettings
) -> TexelDepths:
    """Depths in maps.

    Args:
        seen: result of :func:`pixel_depth`.
        hit: mask of the texels that see a surface.
        view, frustum: those of each texel's map.
        settings: settings of the maps.

    Floors that cast no shadows may leave the depth range. If their depths were only clamped to the far plane, receivers would be
    darkened along the line where the floor crosses it: filtered depths there lie before the floor. So the last texels of the
    floor, which look-ups mix with empty texels, are treated as empty. That lets more light through, not less.
    """
    size = settings.resolution * settings.supersampling
    depth, dx, dy = seen
    linear, to_linear = linear_depth(view, frustum, depth)
    with dr.suspend_grad():
        slopes = [dr.detach(to_linear * slope) for slope in (dx, dy)]
        slope_square = _slope_square(dr.detach(view), dr.detach(frustum), dr.detach(linear), slopes, size)
        last = (frustum.last - frustum.first) / (frustum.far - frustum.first) - 0.5
        ends = dr.fma(reach_of(settings.filter_size) * settings.supersampling, dr.sqrt(slope_square), dr.detach(linear)) > FAR
        shown = hit & ~(ends & (dr.detach(linear) > last) & (frustum.last < frustum.far))
        slope_square = dr.select(shown, slope_square, 0)
    return TexelDepths(shown, dr.select(shown, linear, FAR), slope_square, depth, dx, dy)


def _two_depths(plain: Float, blended: Float) -> tuple[Float, int]:
    """(depth at the centre, other depth, its share, padding) of each texel from its moments without and with anti-aliasing.

    Blended depths cannot be compared, but the two depths that were blended follow from the moments. The padding is there because
    packets of four numbers are read, and their gradients summed, much faster than three numbers.
    """
    module = backend(plain)
    dr.eval(blended)
    texel = dr.arange(module.UInt32, dr.width(plain) // 2)
    depth = dr.gather(module.Array2f, plain, texel).x
    other, share = other_depth(depth, dr.gather(module.Array2f, blended, texel))
    return ravel(module.Array4f(depth, other, share, 0)), 4


def block_means(values: Float, size: int, channels: int, factor: int) -> Float:
    """Means of blocks of factor x factor texels; maps have ``size`` texels along each side."""
    module = backend(values)
    dr.eval(values)
    index = dr.arange(module.UInt32, dr.width(values) // factor**2)
    texel = index // channels
    # Rows of the whole batch: maps lie below each other.
    row = quotient(texel, "blocks", size // factor)
    column = texel - row * uint_input(module, "blocks", size // factor)
    width = uint_input(module, "width", size)
    first = (row * factor * width + column * factor) * channels + (index - texel * channels)
    total = module.Float(0)
    for j in range(factor):
        for i in range(factor):
            # Each number is read once here, so that the backward pass needs no atomics. Other operations may read it, too.
            total += dr.gather(module.Float, values, first + (j * width + i) * channels, mode=dr.ReduceMode.NoConflicts)
    return total * (1 / factor**2)


def _radial_depth(view: Views, frustum: Frusta, raster: RasterOutput, row: UInt32, column: UInt32, size: int) -> Float:
    """Distance from the light camera's origin to the surface that a texel sees."""
    module = backend(raster.triangle)
    perspective = view.spread > 0
    z = dr.select(perspective, raster.w, dr.fma(0.5 * raster.depth + 0.5, frustum.far - frustum.near, frustum.near))
    scale = dr.select(perspective, z, 1.0)
    side, start = float_input(module, "width", size), float_input(module, "width", 1 - size)
    x = dr.fma((2 * module.Float(column) + start) / side, frustum.half_x, frustum.center_x) * scale
    y = dr.fma((2 * module.Float(row) + start) / side, frustum.half_y, frustum.center_y) * scale
    return dr.sqrt(dr.fma(x, x, dr.fma(y, y, z * z)))


def _slope_square(view: Views, frustum: Frusta, linear: Float, slopes: list[Float], size: int) -> Float:
    """Squared change of linear depth across a texel, given its change along both axes."""
    n, f = frustum.first, frustum.far
    # The side of a texel in units of depth.
    texel = (
        dr.select(view.spread > 0, dr.fma(linear + 0.5, f - n, n), 1.0)
        * float_input(backend(linear), "width", 2 / size)
        / (f - n)
    )
    sx = dr.minimum(dr.abs(slopes[0]), _MAX_SLOPE * texel * frustum.half_x)
    sy = dr.minimum(dr.abs(slopes[1]), _MAX_SLOPE * texel * frustum.half_y)
    return sx * sx + sy * sy


def filter_maps(maps: ShadowMaps) -> ShadowMaps:
    """Step 2: pre-filter. Maps whose depths are compared in the look-up are returned unchanged. Attached."""
    s = maps.settings
    if not s.filterable:
        return maps
    kernel = filter_kernel(s.filter, s.filter_size, s.compat)
    values = filter_map(maps.values, kernel, maps.views.count, s.resolution, s.resolution, maps.channels)
    return ShadowMaps(values, maps.views, maps.frusta, s, maps.channels)

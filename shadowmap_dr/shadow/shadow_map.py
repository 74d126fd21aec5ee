"""Shadow maps in three steps: render maps, filter maps, compute visibility."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import drjit as dr

from ..jit.arrays import backend, interleave, ravel
from ..jit.broadcast import in_copies
from ..jit.handover import interleaved
from ..jit.kernel_inputs import float_input, quotient, uint_input
from ..jit.types import Bool, Float, Point3f, UInt32
from ..raster import RasterOutput, Topology, antialias, visible_triangles
from ..raster.screen_planes import pixel_depth
from ..raster.types import pixel_coordinates
from .filters import filter_kernel, filter_map
from .light_camera import Frusta, Views, of_map, tile_rows, to_clip
from .methods.comparison import other_depth
from .methods.depth_scale import DepthScale
from .methods.registry import PREFILTERED
from .methods.variance import variance_moments
from .settings import ShadowSettings
from .texel_depths import depth_scale, texel_depths
from .tiles import Rows
from .transmittance_maps import TranslucentCasters, TransmittanceMaps, render_transmittance


@dataclass(frozen=True)
class ShadowMaps:
    """A batch of M square maps.

    Attributes:
        values: (M * N * N * C,), flat: numbers that the method stores in each texel, such as two moments of depth. Attached.
        views, frusta: cameras of the maps.
        settings: settings of the maps.
        channels: C.
        transmittance: light that translucent casters take away, None if there are none.
        copies: number of consecutive copies of values and views, one for each block of points (:meth:`for_points`).
        tile_rows: numbers of the maps, if many points look up tiles (:meth:`for_points`); else None.
    """

    values: Float
    views: Views
    frusta: Frusta
    settings: ShadowSettings
    channels: int
    transmittance: TransmittanceMaps | None = None
    copies: int = 1
    tile_rows: Rows | None = None

    @property
    def count(self) -> int:
        """Number of maps M."""
        return self.views.count // self.copies

    def for_points(self, count: int) -> ShadowMaps:
        """The same maps, prepared for look-ups by ``count`` points at once, and copied so that gradients are summed exactly.

        Attached.
        """
        rows = tile_rows(self.views, self.frusta, count)
        stored = () if self.transmittance is None else (self.transmittance.values,)
        (values, *columns), copies = in_copies([self.values, *stored, *self.views.columns()], count)
        if copies == 1:
            return self if rows is None else replace(self, tile_rows=rows)
        transmittance = self.transmittance and replace(self.transmittance, values=columns[0])
        views = Views.of(columns[len(stored) :])
        return replace(self, values=values, views=views, transmittance=transmittance, copies=copies, tile_rows=rows)


def render_maps(
    p_light: Point3f,
    map_index: UInt32,
    faces: UInt32,
    topology: Topology,
    views: Views,
    frusta: Frusta,
    settings: ShadowSettings,
    culled: Bool | None = None,
    drawn: Bool | None = None,
    translucent: TranslucentCasters | None = None,
) -> ShadowMaps:
    """Step 1: rasterize all maps at once and encode the depths in each texel by the method. Attached to ``p_light``.

    Args:
        p_light: (M * V,) vertices in each map's light space (:func:`to_light_space`). Attached.
        map_index: map of each lane of ``p_light``.
        faces: (3 F,), flat, valid indices.
        topology: topology of the mesh.
        views, frusta: cameras of the M maps.
        culled: (F,), or (M F,) by map: faces that are not drawn where they face away from the light.
        drawn: (F,), faces that are opaque; None if all of them are.
        translucent: the casters that are not. Attached.
    """
    count, size = views.count, settings.resolution * settings.supersampling
    clip = vertices_of_maps(views, frusta, p_light, map_index)
    # Seen from the front, outlines run clockwise: a light looks along the third of its right-handed axes.
    raster = visible_triangles(clip, faces, (size, size), batch=count, one_sided=culled, drawn=drawn)
    texels = _texels(raster, clip, faces, views, frusta, settings, size)
    channels = len(texels)
    if settings.antialias and settings.method != "standard":
        if settings.method == "pcf":
            plain = interleaved("texels", texels)
            values, channels = _two_depths(plain, antialias(plain, raster, clip, topology))
        else:
            values = antialias(texels, raster, clip, topology)
    else:
        values = interleave(texels)
    if settings.supersampling > 1:
        values = block_means(values, size, channels, settings.supersampling)
    transmittance = None
    if translucent is not None:
        transmittance = render_transmittance(translucent, clip, views, frusta, settings.of_transmittance)
        if settings.supersampling > 1:
            transmittance = transmittance.map(lambda flat, channels: block_means(flat, size, channels, settings.supersampling))
    return ShadowMaps(values, views, frusta, settings, channels, transmittance)


def vertices_of_maps(views: Views, frusta: Frusta, p_light: Point3f, map_index: UInt32) -> Float:
    """Clip-space vertices (4 M V,) of all maps. Arguments as of :func:`render_maps`; attached to ``p_light``."""
    in_maps = to_clip(of_map(views, map_index, views.count), of_map(frusta, map_index, views.count), p_light)
    return interleaved("positions in maps", list(in_maps))


def _texels(
    raster: RasterOutput, clip: Float, faces: UInt32, views: Views, frusta: Frusta, settings: ShadowSettings, size: int
) -> list[Float]:
    """Channels of the texels, for maps of ``size`` texels along each side."""
    module = backend(raster.triangle)
    image, row, column = pixel_coordinates(module, views.count, size, size)
    view, frustum = of_map(views, image, views.count), of_map(frusta, image, views.count)
    hit = raster.valid
    slope_square: Float | float = 0
    scale = DepthScale(0)
    if settings.compat:
        depth = _radial_depth(view, frustum, raster, row, column, size)
        depth = dr.select(hit, depth, frustum.far)
    else:
        seen = pixel_depth(raster, clip, faces, dr.detach(views.spread) > 0)
        texels = texel_depths(seen, hit, view, frustum, settings)
        depth, slope_square = texels.depth, texels.slope_square
        scale = depth_scale(view, frustum, depth, settings, frusta.tiles is not None)
    method = PREFILTERED.get(settings.method)
    if method is None:
        if settings.method == "pcf" and settings.antialias:
            return list(variance_moments(depth))
        return [depth]
    return list(method.encode(depth, slope_square, settings.order, scale))


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


def filter_maps(maps: ShadowMaps) -> ShadowMaps:
    """Step 2: pre-filter. Depths that are compared in the look-up stay as they are. Attached."""
    s = maps.settings

    def filtered(values: Float, channels: int, of: ShadowSettings = s) -> Float:
        kernel = filter_kernel(of.filter, of.filter_size, of.compat)
        return filter_map(values, kernel, maps.views.count, of.resolution, of.resolution, channels)

    if maps.transmittance is not None:
        maps = replace(maps, transmittance=maps.transmittance.map(partial(filtered, of=s.of_transmittance)))
    return replace(maps, values=filtered(maps.values, maps.channels)) if s.filterable else maps

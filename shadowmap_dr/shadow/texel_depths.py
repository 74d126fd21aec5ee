"""Depths that the texels of a shadow map see."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr

from ..jit.arrays import backend
from ..jit.kernel_inputs import float_input
from ..jit.types import Bool, Float
from .filters import reach_of
from .light_camera import Frusta, Views, linear_depth
from .methods.depth_scale import DepthScale
from .settings import ShadowSettings

#: Depth of empty texels. Receivers behind it are moved to it, so that a receiver over empty texels lies at their mean.
FAR = 0.5
# Largest slope that counts as variance, in texels of depth per texel. Surfaces seen edge-on have unbounded slopes.
_MAX_SLOPE = 2.0
# Least deviation of depths: in sides of the filter's footprint, and at most a share of the depth range.
_FOOTPRINTS, _MOST = 1.2, 1e-5**0.5
# That of tiles. The exponent of the warp for near casters is 1 for depth ranges of 16 footprints, and grows by a quarter for each
# further one, up to a limit.
_FOOTPRINTS_OF_TILES, _SPREAD, _SHALLOW, _LARGEST = 1.1, 0.25, 16, 20.0


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


def _slope_square(view: Views, frustum: Frusta, linear: Float, slopes: list[Float], size: int) -> Float:
    """Squared change of linear depth across a texel, given its change along both axes."""
    texel = texel_side(view, frustum, linear, size)
    sx = dr.minimum(dr.abs(slopes[0]), _MAX_SLOPE * texel * frustum.half_x)
    sy = dr.minimum(dr.abs(slopes[1]), _MAX_SLOPE * texel * frustum.half_y)
    return sx * sx + sy * sy


def texel_side(view: Views, frustum: Frusta, linear: Float, size: int) -> Float:
    """Side of a texel at a linear depth as a share of the depth range, over the map's half-width. Detached.

    ``size``: texels along each side of the map.
    """
    n, f = frustum.first, frustum.far
    distance = dr.select(view.spread > 0, dr.fma(dr.detach(linear) + 0.5, f - n, n), 1.0)
    return distance * float_input(backend(linear), "width", 2 / size) / (f - n)


def depth_scale(view: Views, frustum: Frusta, linear: Float, settings: ShadowSettings, tiled: bool) -> DepthScale:
    """Scale on which a map tells apart depths about a linear depth.

    It follows the longer side of the filter's footprint (of a texel without a filter). ``tiled``: the map is one of tiles, whose
    depth range hardly exceeds that of the surfaces in view.
    """
    view = dr.detach(view)
    half = dr.maximum(frustum.half_x, frustum.half_y)
    side = texel_side(view, frustum, linear, settings.resolution) * half * settings.footprint
    coarse: Float = dr.minimum(_FOOTPRINTS * side, _MOST)
    if not tiled:
        return DepthScale(coarse)
    # Depths of spots do not count from planes.
    perspective = view.spread > 0
    fine: Float = dr.clip(1 + _SPREAD * (dr.rcp(side) - _SHALLOW), 1, _LARGEST)
    one = backend(linear).Float(1)
    return DepthScale(dr.select(perspective, coarse, _FOOTPRINTS_OF_TILES * side), dr.select(perspective, one, fine))

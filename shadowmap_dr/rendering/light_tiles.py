"""Texels follow pixels: the number of maps that share a light's image plane, and the texels of single maps."""

from __future__ import annotations

import math
from dataclasses import replace

import drjit as dr
import numpy as np
import numpy.typing as npt

from ..scene.load import SceneData
from ..shadow import Frusta, ShadowSettings, Views, project, stack_views
from .gbuffer.camera_view import VisiblePoints
from .light_loops import MANY_LIGHTS
from .light_slices import TexelLayers, map_bytes
from .settings import RenderSettings
from .shadow_pass import MapPlan

# Texels for each pixel in the part of the image that a light's map covers.
_TEXELS = 1.25
# From so many lights on, each has a small share in the errors of the image. In small images their maps have one texel for each
# pixel, and at least so many along each side, a multiple of a number.
_MANY_ERRORS, _FEWEST, _STEP = 4, 128, 32
# Texels of transmittance maps, along each side, over the root of the number of samples, if these cover all of a map.
_FINE = 2.3
# They have at least so many, a multiple of a number.
_FEWEST_OF_TRANSMITTANCE, _PACKET = 32, 8
# Cells along each side of a map that are looked at for points that the camera sees.
_CELLS = 32
# Most maps of a light that its pixels are not worth, where the camera sees most of them in a small part of one map.
_MOST_CROWDED = 4
# Pixels that see a tile, at most, over their mean number.
_UNEVEN = 2


def sized(shadow: ShadowSettings, plan: MapPlan, pixels: int) -> ShadowSettings:
    """Settings of the maps of lights without extent, for images of so many pixels: many lights, and tiles, have smaller maps in
    small images.

    They have the fewer texels, none smaller than a pixel, that tiles have in large images; like these, they are not filtered.
    """
    if not _is_automatic(shadow):
        return shadow
    if plan.groups:
        pixels = math.ceil(_UNEVEN * _TEXELS * pixels / min(plan.tiles))
    elif len(plan.kinds) < _MANY_ERRORS:
        return shadow
    return shadow.fewer(max(_FEWEST, _STEP * math.ceil(math.sqrt(pixels) / _STEP)))


def texel_density(plan: MapPlan, data: SceneData, shadow: ShadowSettings, fit: Frusta | None, seen: VisiblePoints) -> float:
    """Texels of maps, along each side, whose texels are somewhat smaller than samples, over the root of the number of samples.

    The map decides in which the points that the camera sees lie closest together. Infinite without maps. Reads back.

    Args:
        plan, data, fit: as of :func:`with_tiles`, with one map for each image plane.
        shadow: settings of the maps.
        seen: points that the camera sees, spread evenly over the samples, and the mask of the valid ones.
    """
    if fit is None or not data.lights:
        return math.inf
    most, samples = 0.0, dr.width(seen[1])
    for first, light, kind in zip(plan.first, data.lights, plan.kinds, strict=True):
        for k, view in enumerate(light.map_views(kind, shadow.resolution, shadow.filter_size)):
            found = _cells_of(stack_views([view]), fit.part(first + k, 1), seen)
            if len(found):
                most = max(most, len(found) / samples / (len(np.unique(found)) / _CELLS**2))
    return _FINE * math.sqrt(most) if most else math.inf


def with_transmittance(settings: RenderSettings, shadow: ShadowSettings, samples: int, density: float) -> ShadowSettings:
    """Settings of maps for scenes with translucent casters, for images of so many samples. ``density``: :func:`texel_density`.

    In small images a pixel looks visibility up several times. Each texel of a transmittance map holds many more numbers: these
    maps have larger texels instead, and a filter that takes the mean over the pixel's footprint.
    """
    side = math.sqrt(samples)
    if not shadow.adaptive or settings.look_ups(int(side)) == 1:
        return shadow
    wanted = min(density * side, shadow.resolution)
    texels = max(_FEWEST_OF_TRANSMITTANCE, _PACKET * math.ceil(wanted / _PACKET))
    return replace(shadow, transmittance_texels=min(texels, shadow.resolution))


def with_tiles(
    plan: MapPlan,
    data: SceneData,
    settings: RenderSettings,
    fit: Frusta | None,
    seen: VisiblePoints,
    samples: int,
    layers: int = 0,
) -> MapPlan:
    """The plan with tiles for each directional light and each spot, as many as its pixels are worth. Reads back.

    Small images are worth one map. If their maps are automatic and the camera sees half of its points where texels are few, as
    where a ground reaches the horizon, they have up to four: as many as samples share a texel at the median of these points.

    They are at most ``settings.shadow.tiles``, and fewer where all maps would take more than ``settings.light_memory``. Many
    lights, which are summed up in a loop, keep one map each; so do four and more in small images.

    Args:
        plan: plan with one map for each light.
        data: the scene.
        settings: settings of the rendering.
        fit: fit of the plan's maps, None if there are none.
        seen: points that the camera sees (Point3f, world space), and the mask of the valid ones.
        samples: samples of the image.
        layers: number of translucent layers of a texel, 0 without translucent casters.
    """
    shadow, lights = settings.shadow, data.lights
    small = samples * _TEXELS < math.sqrt(2) * shadow.resolution**2
    crowds = _is_automatic(shadow) and len(lights) < _MANY_ERRORS
    if fit is None or shadow.tiles == 1 or (small and not crowds) or len(lights) >= MANY_LIGHTS:
        return plan
    wanted = list(plan.tiles)
    for k, (light, kind) in enumerate(zip(lights, plan.kinds, strict=True)):
        if kind in ("directional", "spot"):  # a cube has six maps, each fitted to the points that it sees
            view = stack_views(light.map_views(kind, shadow.resolution, shadow.filter_size))
            cells = _cells_of(view, fit.part(plan.first[k], 1), seen)
            share, texels = samples / dr.width(seen[1]), shadow.resolution**2
            spread = len(cells) * share * _TEXELS / texels
            wanted[k] = 2 ** round(math.log2(max(spread, 1)))
            if crowds and len(cells):
                crowd = np.median(np.bincount(cells)[cells]) * share * _CELLS**2 / texels
                wanted[k] = max(wanted[k], min(2 ** int(math.log2(max(crowd, 1))), _MOST_CROWDED))
    most = 2 ** int(math.log2(shadow.tiles))
    room = settings.light_memory * 2**30 / map_bytes(shadow, data.geometry, TexelLayers(layers))
    while True:
        divided = replace(plan, tiles=tuple(min(tiles, most) for tiles in wanted))
        if most == 1 or divided.maps <= room:
            return divided
        most //= 2


def _cells_of(view: Views, fit: Frusta, seen: VisiblePoints) -> npt.NDArray[np.int64]:
    """Cell of a map (one of ``_CELLS`` squared) in which each of the visible points within the map lies."""
    u, v, _, inside = project(view, fit, seen[0])
    chosen = (inside & seen[1]).numpy()
    column, row = (((place.numpy()[chosen] * 0.5 + 0.5) * _CELLS).astype(np.int64) for place in (u, v))
    return np.clip(row, 0, _CELLS - 1) * _CELLS + np.clip(column, 0, _CELLS - 1)


def _is_automatic(shadow: ShadowSettings) -> bool:
    """True if a renderer chooses the texels of maps."""
    return shadow.adaptive and shadow.resolution == ShadowSettings.resolution

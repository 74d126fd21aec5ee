"""Texels follow pixels: the number of maps that share a light's image plane, and the texels of single maps."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ..jit.types import Bool, Point3f
from ..scene.load import SceneData
from ..shadow import Frusta, ShadowSettings, project, stack_views
from .light_loops import MANY_LIGHTS
from .light_slices import map_bytes
from .settings import RenderSettings
from .shadow_pass import MapPlan

# Texels for each pixel in the part of the image that a light's map covers.
_TEXELS = 1.25
# From so many lights on, each has a small share in the errors of the image. In small images their maps have one texel for each
# pixel, and at least so many along each side, a multiple of a number.
_MANY_ERRORS, _FEWEST, _STEP = 4, 128, 32
# Texels of transmittance maps for each sample, along each side, a multiple of a number.
_FINE, _FEWEST_OF_TRANSMITTANCE, _PACKET = 1.25, 32, 8


def sized(shadow: ShadowSettings, plan: MapPlan, pixels: int) -> ShadowSettings:
    """Settings of the maps of lights without extent, for images of so many pixels: many lights have smaller maps in small images.

    So they have the fewer texels, none smaller than a pixel, that tiles have in large images; like these, they are not filtered.
    """
    if not shadow.adaptive or shadow.resolution != ShadowSettings.resolution:
        return shadow
    if plan.groups or len(plan.kinds) < _MANY_ERRORS:
        return shadow
    return shadow.fewer(max(_FEWEST, _STEP * math.ceil(math.sqrt(pixels) / _STEP)))


def with_transmittance(settings: RenderSettings, shadow: ShadowSettings, samples: int) -> ShadowSettings:
    """Settings of maps for scenes with translucent casters, for images of so many samples.

    In small images a pixel looks visibility up several times. Each texel of a transmittance map holds many more numbers: these
    maps have larger texels instead, and a filter that takes the mean over the pixel's footprint.
    """
    side = math.sqrt(samples)
    if not shadow.adaptive or settings.look_ups(int(side)) == 1:
        return shadow
    wanted = max(_FEWEST_OF_TRANSMITTANCE, _PACKET * math.ceil(_FINE * side / _PACKET))
    return replace(shadow, transmittance_texels=min(wanted, shadow.resolution))


def with_tiles(
    plan: MapPlan, data: SceneData, settings: RenderSettings, fit: Frusta | None, seen: tuple[Point3f, Bool], samples: int
) -> MapPlan:
    """The plan with tiles for each directional light and each spot, as many as its pixels are worth. Reads back.

    They are at most ``settings.shadow.tiles``, and fewer where all maps would take more than ``settings.light_memory``. Many
    lights, which are summed up in a loop, keep one map each.

    Args:
        plan: plan with one map for each light.
        data: the scene.
        settings: settings of the rendering.
        fit: fit of the plan's maps, None if there are none.
        seen: points that the camera sees (Point3f, world space), and the mask of the valid ones.
        samples: samples of the image.
    """
    shadow, lights = settings.shadow, data.lights
    small = samples * _TEXELS < math.sqrt(2) * shadow.resolution**2
    if fit is None or shadow.tiles == 1 or small or len(lights) >= MANY_LIGHTS:
        return plan
    wanted = list(plan.tiles)
    for k, (light, kind) in enumerate(zip(lights, plan.kinds, strict=True)):
        if kind in ("directional", "spot"):  # a cube has six maps, each fitted to the points that it sees
            view = stack_views(light.map_views(kind, shadow.resolution, shadow.filter_size))
            _, _, _, inside = project(view, fit.part(plan.first[k], 1), seen[0])
            texels = np.mean((inside & seen[1]).numpy()) * samples * _TEXELS
            wanted[k] = 2 ** round(math.log2(max(texels / shadow.resolution**2, 1)))
    most, room = 2 ** int(math.log2(shadow.tiles)), settings.light_memory * 2**30 / map_bytes(shadow, data.geometry)
    while True:
        divided = replace(plan, tiles=tuple(min(tiles, most) for tiles in wanted))
        if most == 1 or divided.maps <= room:
            return divided
        most //= 2

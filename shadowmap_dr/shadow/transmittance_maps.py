"""Transmittance maps: the light that translucent casters take away, by depth, beside the shadow maps of opaque ones.

Along a light ray, each translucent surface takes away a part of what the surfaces before it have left. A texel stores these
parts, and their distribution over depth: moments of the depths, weighted by the parts, in the encoding of the shadow maps. All
numbers are linear in the light that is lost, so they can be anti-aliased and filtered. A receiver gets the light that is left,
and that of the parts which lie behind it. The nearest surfaces have a distribution each, and all others share one.

Source: the distributions are those of variance and moment shadow maps (see :mod:`.methods`), with the weights of Salvi et al.,
"Adaptive Volumetric Shadow Maps", 2010, section 3: the light that is lost at a depth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr

from ..jit.arrays import backend
from ..jit.handover import interleaved
from ..jit.types import Bool, Float, UInt32
from ..raster import RasterOutput, Topology, antialias, peeled_layers
from ..raster.screen_planes import pixel_depth
from ..raster.types import pixel_coordinates
from .light_camera import Frusta, Views, of_map
from .methods.registry import PREFILTERED, Method
from .settings import ShadowSettings
from .texel_depths import texel_depths

# Weight of a surface that takes nothing away: its depth is known, and with it the derivative by its opacity.
_LEAST_WEIGHT = 1e-6
# Distributions of texels that see few layers, and of others.
_FEW_LAYERS, _FEW_GROUPS, _MANY_GROUPS = 8, 2, 4


@dataclass(frozen=True)
class TranslucentCasters:
    """Faces that let some light pass straight on, T of them.

    Attributes:
        faces: (3 T,) vertices of the faces.
        topology: edges of these faces.
        layers: most of these surfaces that a texel keeps.
        passes: most of these surfaces that a texel looks at.
        through: transmittance, a list of colour channels (``Float``), of the surfaces that texels see, for light that arrives
            from each texel's camera. Attached.
        counts: mask of the surfaces that a texel keeps, None for all of them.
    """

    faces: UInt32
    topology: Topology
    layers: int
    passes: int
    through: Callable[[RasterOutput, Views], list[Float]]
    counts: Callable[[RasterOutput], Bool] | None = None


@dataclass(frozen=True)
class TransmittanceMaps:
    """Distributions of the light that is lost, in M maps of N x N texels.

    Attributes:
        groups: (M N N C,) each: for each texel the light lost of each colour, its mean, and that mean times each number of the
            encoded depth, the last one as often as it fills packets of four. The nearest surface comes first. Attached.
        channels: C.
        colours: number of colours.
    """

    groups: tuple[Float, ...]
    channels: int
    colours: int

    def each(self, function: Callable[[Float, int], Float]) -> TransmittanceMaps:
        """The maps with ``function(group, C)`` in the place of each group."""
        return replace(self, groups=tuple(function(group, self.channels) for group in self.groups))


def depth_encoding(settings: ShadowSettings) -> Method:
    """The encoding of depths."""
    return PREFILTERED[settings.transmittance_method]


def groups_of(settings: ShadowSettings, layers: int) -> int:
    """Number of distributions of a texel that sees so many translucent casters."""
    return min(settings.transmittance_groups or (_FEW_GROUPS if layers <= _FEW_LAYERS else _MANY_GROUPS), layers)


def render_transmittance(
    casters: TranslucentCasters, clip: Float, views: Views, frusta: Frusta, settings: ShadowSettings
) -> TransmittanceMaps:
    """Peel the translucent casters of all maps at once, and encode the light that they take away. Attached.

    Args:
        casters: the casters.
        clip: (4 M V,) clip-space vertices of all maps. Attached.
        views, frusta: cameras of the M maps.
        settings: settings of the maps.
    """
    module, count, size = backend(clip), views.count, settings.resolution * settings.supersampling
    layers = peeled_layers(
        *(clip, casters.faces, (size, size)),
        batch=count,
        layers=casters.layers,
        passes=casters.passes,
        counts=casters.counts,
    )
    image, _, _ = pixel_coordinates(module, count, size, size)
    view, frustum = of_map(views, image, count), of_map(frusta, image, count)
    perspective = dr.detach(views.spread) > 0
    method, count_of_groups = depth_encoding(settings), groups_of(settings, casters.layers)
    # From back to front. Outlines of a surface blend all that lies behind it, too, as an image of the light ray would.
    groups: list[list[Float]] = []
    colours = 0
    for number in reversed(range(casters.layers)):
        raster = layers[number]
        through = casters.through(raster, view)
        seen = pixel_depth(raster, clip, casters.faces, perspective)
        texels = texel_depths(seen, raster.valid, view, frustum, settings)
        own = _lost(through, texels.shown, method.encode(texels.depth, texels.slope_square, settings.order))
        colours = len(through)
        rest = _mean(through)
        passed = [dr.select(texels.shown, value, 1) for value in (*through, *(rest,) * (len(own) - colours))]
        behind = [[value * left for value, left in zip(group, passed, strict=True)] for group in groups]
        following = (number + 1) * count_of_groups // casters.layers
        if not behind or number * count_of_groups // casters.layers < following:
            behind.insert(0, own)
        else:
            behind[0] = [a + b for a, b in zip(own, behind[0], strict=True)]
        groups = _outlined(behind, raster, clip, casters.topology, settings)
    # A multiple of four numbers, as filters and look-ups need. Not zeros: Dr.Jit 1.5 ends the process in forward mode where only
    # some of the numbers are attached.
    groups = [group + group[-1:] * (-len(group) % 4) for group in groups]
    return TransmittanceMaps(tuple(interleaved("transmittance", group) for group in groups), len(groups[0]), colours)


def _lost(through: list[Float], shown: Bool, numbers: list[Float]) -> list[Float]:
    """Numbers of a texel for one surface alone: see :attr:`TransmittanceMaps.groups`."""
    taken = [dr.select(shown, 1 - value, 0) for value in through]
    weight = _mean(taken) + dr.select(shown, _LEAST_WEIGHT, 0)
    return [*taken, weight, *(dr.select(shown, weight * number, 0) for number in numbers)]


def _mean(values: list[Float]) -> Float:
    total = values[0]
    for value in values[1:]:
        total = total + value
    return total * (1 / len(values))


def _outlined(
    groups: list[list[Float]], raster: RasterOutput, clip: Float, topology: Topology, settings: ShadowSettings
) -> list[list[Float]]:
    """Numbers of all groups, anti-aliased at the outlines of one layer, and evaluated."""
    flat = [value for group in groups for value in group]
    if not settings.antialias or not topology.count:
        dr.eval(flat)
        return groups
    values = interleaved("layers of texels", flat)
    blended, module, count = antialias(values, raster, clip, topology), backend(clip), len(flat)
    texel = dr.arange(module.UInt32, dr.width(blended) // count)
    mode = dr.ReduceMode.NoConflicts  # each number is read once
    apart = [dr.gather(module.Float, blended, texel * count + k, mode=mode) for k in range(count)]
    each = len(groups[0])
    return [apart[first : first + each] for first in range(0, count, each)]

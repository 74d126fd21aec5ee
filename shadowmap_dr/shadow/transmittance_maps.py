"""Transmittance maps: the light that translucent casters take away, by depth, beside the shadow maps of opaque ones.

Along a light ray, each translucent surface takes away a part of what the surfaces before it have left. A texel stores these
parts, and their distribution over depth: moments of the depths, weighted by the parts, in the encoding of the shadow maps. All
numbers are linear in the light that is lost, so they can be anti-aliased and filtered. A receiver gets the light that is left,
and that of the parts which lie behind it. Surfaces are put into groups by their order, and each group has a distribution.

Source: the distributions are those of variance and moment shadow maps (see :mod:`.methods`), with the weights of Salvi et al.,
"Adaptive Volumetric Shadow Maps", 2010, section 3: the light that is lost at a depth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr

from ..jit.arrays import backend
from ..jit.broadcast import copied
from ..jit.handover import apart, interleaved
from ..jit.kernel_inputs import split
from ..jit.types import Bool, Float, UInt32
from ..raster import RasterOutput, Topology, antialias, peeled_layers, stacked
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
# Most texels, or vertices times four, of layers that are in memory together.
_MOST_NUMBERS = 1 << 21


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
        attached: False if neither vertices nor transmittance carry gradients.
    """

    faces: UInt32
    topology: Topology
    layers: int
    passes: int
    through: Callable[[RasterOutput, Views], list[Float]]
    counts: Callable[[RasterOutput], Bool] | None = None
    attached: bool = True


@dataclass(frozen=True)
class TransmittanceMaps:
    """Distributions of the light that is lost, in M maps of N x N texels.

    Attributes:
        values: (M N N G C,). Each texel has G distributions, the nearest surfaces first: the light lost of each colour, its mean,
            and that mean times each number of the encoded depth, the last one as often as it fills packets of four. Attached.
        groups: G.
        channels: C.
        colours: number of colours.
    """

    values: Float
    groups: int
    channels: int
    colours: int

    def map(self, function: Callable[[Float, int], Float]) -> TransmittanceMaps:
        """The maps with ``function(values, G C)`` in the place of their values."""
        return replace(self, values=function(self.values, self.groups * self.channels))


def depth_encoding(settings: ShadowSettings) -> Method:
    """The encoding of depths."""
    return PREFILTERED[settings.transmittance_method]


def groups_of(settings: ShadowSettings, layers: int) -> int:
    """Number of distributions of a texel that sees so many translucent casters."""
    return min(settings.transmittance_groups or (_FEW_GROUPS if layers <= _FEW_LAYERS else _MANY_GROUPS), layers)


def render_transmittance(
    casters: TranslucentCasters, clip: Float, views: Views, frusta: Frusta, settings: ShadowSettings
) -> TransmittanceMaps:
    """The maps (:func:`_rendered`), detached if neither casters nor lights are attached: other casters move in ``clip``, too."""
    if casters.attached or dr.grad_enabled(views, frusta):
        return _rendered(casters, clip, views, frusta, settings)
    with dr.suspend_grad():
        return _rendered(casters, dr.detach(clip), views, frusta, settings)


def _rendered(
    casters: TranslucentCasters, clip: Float, views: Views, frusta: Frusta, settings: ShadowSettings
) -> TransmittanceMaps:
    """Peel the translucent casters of all maps at once, and encode the light that they take away. Attached.

    Args:
        casters: the casters.
        clip: (4 M V,) clip-space vertices of all maps. Attached.
        views, frusta: cameras of the M maps.
        settings: settings of the maps.
    """
    count, size = views.count, settings.resolution * settings.supersampling
    layers = peeled_layers(
        *(clip, casters.faces, (size, size)),
        batch=count,
        layers=casters.layers,
        passes=casters.passes,
        counts=casters.counts,
    )
    groups = groups_of(settings, casters.layers)
    at_once = max(1, _MOST_NUMBERS // max(count * size * size, dr.width(clip)))
    light, colours = _Light(), 0
    for first in range(0, casters.layers, at_once):
        chosen = layers[first : first + at_once]
        raster, positions = stacked(chosen, clip, casters.faces, count)
        numbers, each, colours = _numbers(casters, raster, positions, views, frusta, settings)
        for k, own in enumerate(apart(numbers, each, len(chosen))):
            light.lose(own, colours, (first + k) * groups // casters.layers)
        if at_once < casters.layers:
            dr.eval(light.left, light.groups)
    # A multiple of four numbers, as filters and look-ups need. Not zeros: Dr.Jit 1.5 ends the process in forward mode where only
    # some of the numbers are attached.
    padded = [group + group[-1:] * (-len(group) % 4) for group in light.groups]
    values = interleaved("transmittance", [value for group in padded for value in group])
    return TransmittanceMaps(values, groups, len(padded[0]), colours)


class _Light:
    """Light on its way through the layers of texels, front to back.

    Attributes:
        groups: numbers of texels, see :attr:`TransmittanceMaps.values`.
        left: light of each colour that is left, and its mean.
    """

    def __init__(self) -> None:
        self.groups: list[list[Float]] = []
        self.left: list[Float] = []

    def lose(self, numbers: list[Float], colours: int, group: int) -> None:
        """Let the light pass one more layer. ``numbers``: those of the layer alone."""
        lost = [*numbers[:colours], _mean(numbers[:colours])]
        taken = numbers
        if self.left:
            factors = self.left + self.left[-1:] * (len(numbers) - colours - 1)
            taken = [value * factor for value, factor in zip(numbers, factors, strict=True)]
            self.left = [left - left * value for left, value in zip(self.left, lost, strict=True)]
        else:
            self.left = [1 - value for value in lost]
        if group == len(self.groups):
            self.groups.append(taken)
        else:
            self.groups[group] = [a + b for a, b in zip(self.groups[group], taken, strict=True)]


def _numbers(
    casters: TranslucentCasters, raster: RasterOutput, positions: Float, views: Views, frusta: Frusta, settings: ShadowSettings
) -> tuple[Float, int, int]:
    """(numbers of all texels of all layers, each for the surface of that layer alone, interleaved; how many a texel has; how many
    colours).

    They are anti-aliased, each layer by itself: what lies behind an outline is taken to be the same on both sides of it.
    """
    count = views.count
    image, _, _ = pixel_coordinates(backend(positions), raster.batch, raster.height, raster.width)
    map_index = split(image, "maps", count, raster.batch // count)[1] if raster.batch > count else image
    view, frustum = of_map(views, map_index, count), of_map(frusta, map_index, count)
    perspective = dr.detach(views.spread) > 0
    if raster.batch > count:
        perspective = copied(perspective, raster.batch // count)
    through = casters.through(raster, view)
    seen = pixel_depth(raster, positions, casters.faces, perspective)
    texels = texel_depths(seen, raster.valid, view, frustum, settings)
    depth = depth_encoding(settings).encode(texels.depth, texels.slope_square, settings.order)
    taken = [dr.select(texels.shown, 1 - value, 0) for value in through]
    weight = _mean(taken) + dr.select(texels.shown, _LEAST_WEIGHT, 0)
    own = [*taken, weight, *(dr.select(texels.shown, weight * number, 0) for number in depth)]
    values = interleaved("layers of texels", own)
    if settings.antialias and casters.topology.count:
        values = antialias(values, raster, positions, casters.topology)
    return values, len(own), len(through)


def _mean(values: list[Float]) -> Float:
    total = values[0]
    for value in values[1:]:
        total = total + value
    return total * (1 / len(values))

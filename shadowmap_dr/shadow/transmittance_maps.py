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
from ..jit.handover import interleaved
from ..jit.kernel_inputs import split
from ..jit.packets import apart
from ..jit.types import Bool, Float, UInt32
from ..raster import RasterOutput, Topology, antialias, peeled_layers, stacked
from ..raster.screen_planes import pixel_depth
from ..raster.types import pixel_coordinates
from .light_camera import Frusta, Views, of_map
from .methods.depth_scale import DepthScale
from .methods.registry import PREFILTERED, Method, most_numbers
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


def numbers_of_texel(settings: ShadowSettings, layers: int, colours: int) -> int:
    """Numbers that a texel stores if it sees so many translucent casters: of all distributions, in packets of four."""
    own = colours + 1 + most_numbers(settings.transmittance_method, settings.order)
    return groups_of(settings, layers) * (own + -own % 4)


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
    light: list[Float] = []
    colours = 0
    for last in range(casters.layers, 0, -at_once):
        first = max(last - at_once, 0)
        raster, positions = stacked(layers[first:last], clip, casters.faces, count)
        own, colours = _numbers(casters, raster, positions, views, frusta, settings)
        composites: list[list[Float]] = []
        for number in reversed(range(first, last)):
            behind = composites[0] if composites else light
            composites.insert(0, _in_front(own[number - first], behind, colours, number * groups // casters.layers, groups))
        light = composites[0]
        if settings.antialias and casters.topology.count:
            light = _outlined(composites, own, colours, raster, positions, casters.topology)
        if first:
            dr.eval(light)
    return TransmittanceMaps(interleaved("transmittance", light), groups, len(light) // groups, colours)


def _numbers(
    casters: TranslucentCasters, raster: RasterOutput, positions: Float, views: Views, frusta: Frusta, settings: ShadowSettings
) -> tuple[list[list[Float]], int]:
    """(numbers of the texels of each layer, for the surface of that layer alone; number of colours)."""
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
    depth = depth_encoding(settings).encode(texels.depth, texels.slope_square, settings.order, DepthScale(0))
    taken = [dr.select(texels.shown, 1 - value, 0) for value in through]
    weight = _mean(taken) + dr.select(texels.shown, _LEAST_WEIGHT, 0)
    own = [*taken, weight, *(dr.select(texels.shown, weight * number, 0) for number in depth)]
    # A multiple of four numbers, as filters and look-ups need. Not zeros: Dr.Jit 1.5 ends the process in forward mode where only
    # some of the numbers are attached.
    own += own[-1:] * (-len(own) % 4)
    return apart(interleaved("layers of texels", own), len(own), raster.batch // count), len(through)


def _in_front(own: list[Float], behind: list[Float], colours: int, group: int, groups: int) -> list[Float]:
    """Numbers of all groups with a layer (``own`` numbers) in front of others (``behind``, none if empty)."""
    first, last = group * len(own), (group + 1) * len(own)
    passed = _passed(own, colours) * groups
    numbers = [left * value for left, value in zip(passed, behind, strict=True)] if behind else [type(own[0])(0)] * len(passed)
    numbers[first:last] = [a + b for a, b in zip(own, numbers[first:last], strict=True)]
    return numbers


def _passed(own: list[Float], colours: int) -> list[Float]:
    """Share of each number of the surfaces behind that a layer lets through."""
    lost = own[:colours]
    return [*(1 - value for value in lost), *([1 - _mean(lost)] * (len(own) - colours))]


def _outlined(
    composites: list[list[Float]],
    own: list[list[Float]],
    colours: int,
    raster: RasterOutput,
    positions: Float,
    topology: Topology,
) -> list[Float]:
    """Numbers of all groups, anti-aliased at the outlines of several layers.

    Outlines of a layer blend that layer and all that lies behind it: surfaces may be in other layers on the other side. Outlines
    of different layers are taken to lie in different texels.

    Args:
        composites: numbers of all groups for each layer and the layers behind it, front to back.
        own: numbers of the surfaces of each layer alone.
        colours: number of colours.
        raster, positions, topology: of all layers.
    """
    count, parts = len(composites[0]), len(composites)
    flat = interleaved("composites of layers", [value for numbers in composites for value in numbers], parts)
    blended = apart(antialias(flat, raster, positions, topology), count, parts)
    light: list[Float] = blended[0]
    left: list[Float] = []
    for k in range(1, parts):
        passed = _passed(own[k - 1], colours) * (count // len(own[0]))
        left = [a * b for a, b in zip(passed, left, strict=True)] if left else passed
        changes = (b - a for a, b in zip(composites[k], blended[k], strict=True))
        light = [dr.fma(factor, change, value) for factor, change, value in zip(left, changes, light, strict=True)]
    return light


def _mean(values: list[Float]) -> Float:
    total = values[0]
    for value in values[1:]:
        total = total + value
    return total * (1 / len(values))

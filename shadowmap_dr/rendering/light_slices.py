"""Slices of a scene's lights, whose shadow maps fit into memory one slice after the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..errors import ShadowmapError
from ..jit.memory import physical_memory
from ..scene.geometry import Geometry
from ..scene.lights.area import AreaLight
from ..scene.lights.read import Light
from ..scene.load import SceneData
from ..shadow import Frusta, ShadowSettings
from ..shadow.methods.registry import most_numbers
from ..shadow.transmittance_maps import numbers_of_texel
from .extended_lights import SoftFrusta, SoftPlan
from .settings import RenderSettings
from .shadow_pass import MapPlan

# Bytes of a map, its derivatives included: for each texel (as it is rasterized), and in addition for each number that the texel
# stores; for each vertex; for each triangle. Measured peaks, rounded up (docs/performance.md).
_TEXEL, _NUMBER, _VERTEX, _TRIANGLE = 50, 20, 112, 56
# Bytes of a texel of a transmittance map: for all layers; for each layer, for each number of a layer, and for the outlines of a
# layer; for each layer without derivatives.
_TRANSMITTANCE, _LAYER, _LAYER_NUMBER, _LAYER_OUTLINES, _FIXED_LAYER = 600, 50, 11, 420, 55
# Bytes of a stored number's gradient, of which each extended light has one for the maps of all of them.
_GRADIENT = 4


@dataclass(frozen=True)
class TexelLayers:
    """Translucent layers of the texels of shadow maps. Static.

    Attributes:
        count: their number.
        attached: True if they carry gradients.
    """

    count: int = 0
    attached: bool = False


#: Those of scenes without translucent casters.
NO_LAYERS = TexelLayers()


@dataclass(frozen=True)
class LightSlice:
    """Consecutive lights, and their maps: (first, last + 1) of each. Static.

    Attributes:
        lights, soft: lights without extent; extended lights, environments after area lights.
        maps, sampled, single: maps of the lights without extent, of samples, and single ones.
    """

    lights: tuple[int, int]
    soft: tuple[int, int]
    maps: tuple[int, int]
    sampled: tuple[int, int]
    single: tuple[int, int]

    def data(self, data: SceneData, lights: Sequence[Light], areas: Sequence[AreaLight]) -> SceneData:
        """The scene with the lights of the slice alone. ``lights``, ``areas``: current records of all lights."""
        (a, b), (c, d), n = self.lights, self.soft, len(areas)
        environments = data.environments[max(c - n, 0) : max(d - n, 0)]
        return replace(data, lights=tuple(lights[a:b]), areas=tuple(areas[c : min(d, n)]), environments=environments)

    def soft_plans(self, plans: Sequence[SoftPlan]) -> tuple[SoftPlan, ...]:
        """The plans of the slice's extended lights, with the numbers that their maps have there."""
        start = {True: self.single[0], False: self.sampled[0]}
        return tuple(replace(plan, first=plan.first - start[plan.kind == "single"]) for plan in plans[slice(*self.soft)])

    def fits(self, fits: tuple[Frusta | None, SoftFrusta]) -> tuple[Frusta | None, SoftFrusta]:
        """The part of a fit of all maps that belongs to the slice."""
        frusta, (sampled, single) = fits
        return _part(frusta, self.maps), (_part(sampled, self.sampled), _part(single, self.single))


def _part(frusta: Frusta | None, maps: tuple[int, int]) -> Frusta | None:
    first, last = maps
    return None if frusta is None or first == last else frusta.part(first, last - first)


def joined_fits(fits: Sequence[tuple[Frusta | None, SoftFrusta]]) -> tuple[Frusta | None, SoftFrusta]:
    """The fit of all maps from those of the slices."""
    columns = [[fit for fit in column if fit is not None] for column in zip(*((f, *soft) for f, soft in fits), strict=True)]
    frusta, sampled, single = (Frusta.joined(column) if column else None for column in columns)
    return frusta, (sampled, single)


def plan_slices(
    data: SceneData,
    plan: MapPlan,
    soft: Sequence[SoftPlan],
    settings: RenderSettings,
    shadow: ShadowSettings | None = None,
    layers: TexelLayers = NO_LAYERS,
) -> tuple[LightSlice, ...]:
    """Slices of the lights, as few and as equal as fit into ``settings.light_memory`` each; none if all lights fit together.

    A light whose maps take more is a slice of its own. A single slice would save nothing: then there are none.

    Args:
        data: the scene.
        plan, soft: maps of the lights without extent, and of the others.
        settings: settings of the rendering.
        shadow: settings of the maps of lights without extent, if they differ from ``settings.shadow``.
        layers: translucent layers of texels.

    Raises:
        ShadowmapError: the maps of a single light take more memory than that and than the machine has.
    """
    if settings.shadow.method == "none" or not settings.lit:
        return ()
    sizes = _Sizes.of(data, plan, soft, settings, shadow or settings.shadow, layers)
    budget, every = int(settings.light_memory * 2**30), sizes.count
    if sizes.bytes(0, every) <= budget:
        return ()
    largest = max(range(every), key=lambda k: sizes.bytes(k, k + 1))
    least, memory = sizes.bytes(largest, largest + 1), physical_memory()
    if least > max(budget, memory):
        names = [light.name for light in (*data.lights, *data.areas, *data.environments)]
        raise ShadowmapError(
            f"The shadow maps of light '{names[largest]}' take {least / 2**30:.3g} GiB, more than light_memory "
            f"({settings.light_memory:g} GiB) and this machine ({memory / 2**30:.3g} GiB): lower shadow_map_resolution, "
            f"soft_map_resolution{', translucent_layers' if layers.count else ''} or the number of the light's samples."
        )
    own = plan.counts
    groups = _groups(sizes, budget)
    return tuple(_slice(first, last, own, soft) for first, last in groups) if len(groups) > 1 else ()


@dataclass(frozen=True)
class _Sizes:
    """Memory for the maps of lights; extended lights come last.

    Attributes:
        maps: bytes of each light's maps.
        gradients: bytes of the gradient of each light's maps, 0 for lights without extent.
    """

    maps: list[int]
    gradients: list[int]

    @classmethod
    def of(
        cls,
        data: SceneData,
        plan: MapPlan,
        soft: Sequence[SoftPlan],
        settings: RenderSettings,
        shadow: ShadowSettings,
        layers: TexelLayers,
    ) -> _Sizes:
        sampled, single = settings.soft_shadow
        kinds = [(count, shadow) for count in plan.counts]
        kinds += [(one.maps, single if one.kind == "single" else sampled) for one in soft]
        maps = [count * map_bytes(setting, data.geometry, layers) for count, setting in kinds]
        gradients = [
            count * _GRADIENT * most_numbers(setting.method, setting.order) * setting.resolution**2 for count, setting in kinds
        ]
        return cls(maps, [0] * len(plan.kinds) + gradients[len(plan.kinds) :])

    @property
    def count(self) -> int:
        return len(self.maps)

    def bytes(self, first: int, last: int) -> int:
        """Estimate of the memory for lights ``first`` to before ``last`` at once."""
        gradients = [size for size in self.gradients[first:last] if size]
        return sum(self.maps[first:last]) + len(gradients) * sum(gradients)


def map_bytes(settings: ShadowSettings, geometry: Geometry, layers: TexelLayers = NO_LAYERS) -> int:
    """Estimate of the memory (bytes) for making, filtering and differentiating one map. ``layers``: of its texels."""
    each = _TEXEL + _NUMBER * most_numbers(settings.method, settings.order)
    texels = (settings.resolution * settings.supersampling) ** 2 * each + _transmittance_bytes(settings, layers)
    return texels + _VERTEX * geometry.vertex_count + _TRIANGLE * geometry.face_count


def _transmittance_bytes(settings: ShadowSettings, layers: TexelLayers) -> int:
    """Estimate of the memory (bytes) for making, filtering and differentiating one transmittance map."""
    if not layers.count:
        return 0
    settings, each = settings.of_transmittance, _FIXED_LAYER
    if layers.attached:
        numbers = numbers_of_texel(settings, layers.count, dr.size_v(mi.UnpolarizedSpectrum))
        each = _LAYER + _LAYER_NUMBER * numbers + _LAYER_OUTLINES * settings.antialias
    return (settings.resolution * settings.supersampling) ** 2 * (_TRANSMITTANCE + each * layers.count)


def _groups(sizes: _Sizes, budget: int) -> list[tuple[int, int]]:
    """(first, last + 1) of consecutive groups, each of at most ``budget``, and as equal as their least number allows."""
    count = len(_filled(sizes, budget))
    low, high = min(budget, max(sizes.bytes(k, k + 1) for k in range(sizes.count))), budget
    while high - low > max(budget // 256, 1):  # the least limit that needs no more groups: equal groups share their kernels
        middle = (low + high) // 2
        low, high = (low, middle) if len(_filled(sizes, middle)) <= count else (middle, high)
    return _filled(sizes, high)


def _filled(sizes: _Sizes, limit: int) -> list[tuple[int, int]]:
    groups, first = [], 0
    for k in range(1, sizes.count):
        if sizes.bytes(first, k + 1) > limit:
            groups.append((first, k))
            first = k
    return [*groups, (first, sizes.count)]


def _slice(first: int, last: int, own: Sequence[int], soft: Sequence[SoftPlan]) -> LightSlice:
    n = len(own)
    a, b, c, d = min(first, n), min(last, n), max(first - n, 0), max(last - n, 0)
    sampled = [0 if plan.kind == "single" else plan.maps for plan in soft]
    single = [plan.maps if plan.kind == "single" else 0 for plan in soft]
    ranges = [(sum(maps[:x]), sum(maps[:y])) for maps, x, y in ((own, a, b), (sampled, c, d), (single, c, d))]
    return LightSlice((a, b), (c, d), *ranges)


def shining_objects(data: SceneData) -> list[mi.Object]:
    """Mitsuba's objects that the light of a scene calls: emitters and their textures."""
    found = [value for light in data.lights for value in vars(light).values() if isinstance(value, mi.Object)]
    return [*found, *(area.emitter for area in data.areas), *(node for sky in data.environments for node in sky.nodes)]

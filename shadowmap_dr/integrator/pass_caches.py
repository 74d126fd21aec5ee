"""Caches of the passes of each sensor's last image, and the results among them that are valid for the next image."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import mitsuba as mi

from ..rendering.pass_cache import CacheLevel, PassCache
from ..rendering.waiting import MOST_SAMPLES
from ..scene.load import SceneData
from ..scene.mitsuba_objects import children, is_attribute, owners
from .parameter_state import ParameterState

# Images whose parameters are remembered.
_MOST_KNOWN = 64

#: Names of a scene's parameters that must not change for each level to stay valid.
NamesByLevel = dict[CacheLevel, list[str]]


@dataclass
class _Known:
    """The cache for a sensor's images with ``spp`` samples per pixel, and parameters at the last one.

    ``weight``: in samples; ``room``: False if there is no memory for the cache, which then stays empty.
    """

    sensor: mi.Sensor
    spp: int
    weight: int
    scene: ParameterState
    camera: ParameterState
    cache: PassCache
    room: bool = True


class PassCaches:
    """Results of passes for each sensor of a scene."""

    def __init__(self) -> None:
        self._names: NamesByLevel = {}
        self._known: list[_Known] = []

    def cache_for(
        self,
        scene: ParameterState,
        camera: ParameterState,
        sensor: mi.Sensor,
        spp: int,
        weight: int,
        names: Callable[[], NamesByLevel],
    ) -> PassCache:
        """Cache of passes for the next image of a sensor, with the results that are still valid.

        Args:
            scene, camera: current parameters.
            sensor, spp: of the image.
            weight: measure of the memory for the image's passes, in samples.
            names: returns :func:`names_by_level` of the scene. Called at the second image.
        """
        if not self._names and self._known:
            self._names = names()
        known = next((one for one in self._known if one.sensor is sensor and one.spp == spp), None)
        # An image of this sensor with other samples tells too what does not change, such as the reference of an optimisation.
        last = known or next((one for one in self._known if one.sensor is sensor), None)
        level = CacheLevel.NOTHING
        if last is not None and (known is None or known.room):
            level = _valid_level(last, scene, camera, self._names)
        if known is None or known.weight != weight:
            known = _Known(sensor, spp, weight, scene, camera, PassCache())
        known.cache.keep(level)
        known.scene, known.camera = scene, camera
        self._known = [known, *(one for one in self._known if one.sensor is not sensor or one.spp != spp)][:_MOST_KNOWN]
        left = MOST_SAMPLES
        for one in self._known:
            left -= one.weight
            one.room = left >= 0
            if not one.room:
                one.cache = PassCache()
        return known.cache

    def forget_edges(self) -> None:
        """Drop all results that depend on the edges at which shading jumps."""
        for known in self._known:
            known.cache.forget_edges()


def _valid_level(known: _Known, scene: ParameterState, camera: ParameterState, names: NamesByLevel) -> CacheLevel:
    """The highest level whose parameters are unchanged since the last image, and not attached."""
    # New parameters may affect any level.
    if camera.attached or not camera.same(known.camera) or len(scene.numbers) != len(known.scene.numbers):
        return CacheLevel.NOTHING
    attached, valid = set(scene.attached), CacheLevel.NOTHING
    for level in (CacheLevel.VIEW, CacheLevel.LIGHTS, CacheLevel.RADIANCE):
        if attached.intersection(names[level]) or not scene.same(known.scene, names[level]):
            return valid
        valid = level
    return valid


def names_by_level(scene: mi.Scene, data: SceneData) -> NamesByLevel:
    """Names of a scene's parameters that must not change for each level to stay valid, except those of materials and sensors."""
    emitters, cameras = set(scene.emitters()), set(_below(scene.sensors()))
    materials, lights = set(_below({source.shape.bsdf() for source in data.sources})), set(_below(emitters))
    # With alpha tests the parameters of materials affect visibility.
    solid = not any(info.see_through for info in data.geometry.shapes)
    names: NamesByLevel = {level: [] for level in CacheLevel}
    for name, node in owners(scene):
        shared = node in materials and node in lights
        if node in cameras:
            continue
        if solid and not shared and (node in materials or is_attribute(node, name.rpartition(".")[2])):
            continue
        if node in emitters:
            level = CacheLevel.LIGHTS
        elif node in lights and not shared:
            level = CacheLevel.RADIANCE
        else:
            level = CacheLevel.VIEW
        names[level].append(name)
    return names


def _below(nodes: Iterable[mi.Object]) -> Iterator[mi.Object]:
    """Mitsuba objects and all their descendants."""
    for node in nodes:
        yield node
        yield from _below(part for _, part in children(node))

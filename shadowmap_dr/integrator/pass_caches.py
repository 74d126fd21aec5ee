"""Caches of the passes of each sensor's last image, and which of their results hold for the next one."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from ..rendering.pass_cache import CacheLevel, PassCache
from ..scene.load import SceneData
from ..scene.mitsuba_objects import children, is_attribute, owners
from .deferred import MOST_SAMPLES
from .parameter_state import ParameterState

#: Names of the parameters of a scene that must stay for each level to be valid.
NamesByLevel = dict[CacheLevel, list[str]]


@dataclass
class _Known:
    """The cache of a sensor's images with so many samples per pixel, and parameters at the last image. ``weight``: in samples."""

    sensor: Any
    spp: int
    weight: int
    scene: ParameterState
    camera: ParameterState
    cache: PassCache


class PassCaches:
    """Results of passes for each sensor of a scene."""

    def __init__(self) -> None:
        self._names: NamesByLevel = {}
        self._known: list[_Known] = []

    def cache_for(
        self,
        scene: ParameterState,
        camera: ParameterState,
        sensor: Any,
        spp: int,
        weight: int,
        names: Callable[[], NamesByLevel],
    ) -> PassCache:
        """Results that the next image of a sensor may use, and leave to later ones.

        Args:
            scene, camera: parameters as they are now.
            sensor, spp: of the image.
            weight: what the memory for the image's passes grows with, in samples.
            names: makes :func:`names_by_level` of the scene. Called at the second image.
        """
        if not self._names and self._known:
            self._names = names()
        known = next((one for one in self._known if one.sensor is sensor and one.spp == spp), None)
        if known is None or known.weight != weight:
            known = _Known(sensor, spp, weight, scene, camera, PassCache())
        else:
            known.cache.keep(_valid_level(known, scene, camera, self._names))
            known.scene, known.camera = scene, camera
        others = [one for one in self._known if one.sensor is not sensor or one.spp != spp]
        room = MOST_SAMPLES
        self._known = []
        for one in [known, *others]:
            room -= one.weight
            if room >= 0:
                self._known.append(one)
        return known.cache if weight <= MOST_SAMPLES else PassCache()

    def forget_edges(self) -> None:
        """Drop all that depends on the edges at which shading jumps."""
        for known in self._known:
            known.cache.forget_edges()


def _valid_level(known: _Known, scene: ParameterState, camera: ParameterState, names: NamesByLevel) -> CacheLevel:
    """The level of all that has stayed since the last image, and is not attached."""
    # Parameters that have come since may mean anything.
    if camera.attached or not camera.same(known.camera) or len(scene.numbers) != len(known.scene.numbers):
        return CacheLevel.NOTHING
    attached, valid = set(scene.attached), CacheLevel.NOTHING
    for level in (CacheLevel.VIEW, CacheLevel.LIGHTS, CacheLevel.RADIANCE):
        if attached.intersection(names[level]) or not scene.same(known.scene, names[level]):
            return valid
        valid = level
    return valid


def names_by_level(scene: Any, data: SceneData) -> NamesByLevel:
    """Names of the parameters of a scene that must stay for each level to hold. Those of materials and sensors are left out."""
    emitters, cameras = set(scene.emitters()), set(_below(scene.sensors()))
    materials, lights = set(_below({source.shape.bsdf() for source in data.sources})), set(_below(emitters))
    # Alpha tests decide on what is seen.
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


def _below(nodes: Iterable[Any]) -> Iterator[Any]:
    """Objects of Mitsuba's and all their parts."""
    for node in nodes:
        yield node
        yield from _below(part for _, part in children(node))

"""Results of replayed images that wait for their backward passes."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi

from ..jit.handover import NO_RESULTS, PackedResults
from ..jit.pytree import with_fields
from ..rendering.renderer import Renderer
from ..rendering.waiting import MOST_SAMPLES
from ..scene.mitsuba_objects import Parameter, parameters_named
from .parameter_state import ParameterState


@dataclass(frozen=True)
class _Handed:
    """Results of one image, its renderer without gradients, its weight in samples, and the parameters of scene and sensor."""

    sensor: mi.Sensor
    spp: int
    weight: int
    scene: ParameterState
    camera: ParameterState
    renderer: Renderer
    results: PackedResults


class HandedResults:
    """Results of the last replayed images of one state of a scene, as far as memory allows."""

    def __init__(self) -> None:
        self._images: list[_Handed] = []
        self._renewed: dict[str, Parameter] | None = None  # by each replay so far, if that is known

    def add(
        self,
        sensor: mi.Sensor,
        spp: int,
        weight: int,
        state: tuple[ParameterState, ParameterState],
        renderer: Renderer,
        results: PackedResults,
    ) -> None:
        """Let results wait. Those of other states of the scene are dropped, and those that have waited longest make room.

        ``weight``: measure of their memory, in samples. ``state``: parameters of the scene, and of the sensor.
        """
        scene, camera = state
        others = [one for one in self._images if one.scene.same(scene) and (one.sensor is not sensor or one.spp != spp)]
        self._images = [*others, _Handed(sensor, spp, weight, scene, camera, renderer, results)]
        # The latest results wait whatever their size: computing them again would take as much memory.
        while len(self._images) > 1 and sum(one.weight for one in self._images) > MOST_SAMPLES:
            self._images.pop(0)

    def take(
        self, sensor: mi.Sensor, spp: int, scene: ParameterState, camera: ParameterState
    ) -> tuple[PackedResults, Renderer | None]:
        """Remove and return the results and the renderer of an image that would be the same now; else none.

        ``scene``, ``camera``: the current parameters.
        """
        self._images = [one for one in self._images if one.scene.same(scene)]
        for one in self._images:
            if one.sensor is sensor and one.spp == spp and one.camera.same(camera):
                self._images.remove(one)
                return one.results, one.renderer
        self._renewed = None  # the replay of an image may have renewed other arrays
        return NO_RESULTS, None

    def follow(self, before: ParameterState, scene: mi.Scene) -> None:
        """Note that a replay, and nothing else, has changed a scene's parameters: it renews arrays of lamps, for instance."""
        if not self._images:
            return
        renewed = self._renewed or {}
        after = before.with_values({name: parameter.now() for name, parameter in renewed.items()})
        if self._renewed is None or renewed and after.same(before):
            # The first replay, or one that has renewed others: these are looked for. Otherwise the few that are known are read.
            after = ParameterState.of(scene)
            changed = {name for name, keys in after.numbers.items() if keys != before.numbers.get(name)}
            found = parameters_named(scene, changed)
            # Attributes of meshes may be removed, and what was known of them with it.
            if not any(isinstance(parameter.node, mi.Shape) for parameter in found.values()):
                self._renewed = found
        self._images = [with_fields(one, scene=after) if one.scene.same(before) else one for one in self._images]

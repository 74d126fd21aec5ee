"""Records of a scene's parameters that are read again only where these have changed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import mitsuba as mi

from ..scene.load import PARTS, READ, SceneData, refresh
from ..scene.mitsuba_objects import owners
from .parameter_state import ParameterState

# Stands for records and their copies; no records are this object.
_NONE = (object(), None)


@dataclass(frozen=True)
class _Part:
    """A part of the records without gradients, at the last reading.

    Attributes:
        keys: of the parameters that it was read from.
        held: the states that keep these keys from being used again.
        records: the part.
    """

    keys: list[Any]
    held: tuple[ParameterState, ParameterState]
    records: Any  # Any: of one of several types


class SceneReader:
    """Reads a scene for one recorded image or backward pass after the other.

    Parts that carry no gradients are the same objects until their parameters change.
    """

    def __init__(self) -> None:
        self._names: dict[str, list[str]] = {}
        self._all: set[str] = set()
        #: Names of parameters that nothing but cameras is read from.
        self.of_cameras: frozenset[str] = frozenset()
        self._parts: dict[str, _Part] = {}
        self._copies: dict[str, tuple[Any, Any]] = dict.fromkeys(PARTS, _NONE)  # Any: as above

    def read(self, data: SceneData, sensor: mi.Sensor, scene: ParameterState, camera: ParameterState) -> SceneData:
        """Records of the current scene with one sensor, attached to the scene's parameters.

        Args:
            data: of the scene, which it names.
            sensor: the sensor.
            scene, camera: the current parameters of the scene, and of a sensor that is foreign to it.
        """
        if scene.numbers.keys() != self._all:
            self._all, self._names, self._parts = set(scene.numbers), _names_by_part(data.scene), {}
            shapes, lights, cameras = (frozenset(self._names[part]) for part in PARTS)
            self.of_cameras = cameras - shapes - lights
        still: dict[str, Any] = {}
        keys: dict[str, list[Any]] = {}
        attached = set(scene.attached)
        for part, names in self._names.items():
            if not attached.isdisjoint(names) or (part == "sensors" and camera.attached):
                self._parts.pop(part, None)  # gradients flow into the graph of one image
                continue
            keys[part] = [scene.numbers[name] for name in names]
            if part == "sensors":
                keys[part] += [sensor, camera.numbers]
            known = self._parts.get(part)
            if known is not None and known.keys == keys[part]:
                still[part] = known.records
        found = refresh(data, sensors=(sensor,), known=still)
        for part, now in keys.items():
            self._parts[part] = _Part(now, (scene, camera), getattr(found, part))
        return found

    def fields(self, data: SceneData) -> tuple[str, ...]:
        """Fields of the last records that may carry gradients."""
        return tuple(field for field in READ if field not in self._parts and getattr(data, field) != ())

    def copies(self, data: SceneData) -> dict[str, Any]:  # Any: fields of different types
        """The :meth:`copied` parts of the same records."""
        return {part: self._copies[part][1] for part in PARTS if self._copies[part][0] is getattr(data, part)}

    def copied(self, data: SceneData, copies: SceneData) -> None:
        """Keep copies of the parts that are kept themselves."""
        for part in PARTS:
            own = getattr(data, part)
            is_kept = part in self._parts and self._parts[part].records is own
            self._copies[part] = (own, getattr(copies, part)) if is_kept else _NONE


def _names_by_part(scene: mi.Scene) -> dict[str, list[str]]:
    """Names of the parameters from which each part of the records is read."""
    own, emitters = owners(scene), scene.emitters()

    def names(nodes: set[mi.Object]) -> list[str]:
        return [name for name, node in own if node in nodes]

    def below(roots: Iterable[mi.Object]) -> set[mi.Object]:
        # Textures, too, that others of the scene's objects name.
        return {node for root in roots for _, node in owners(root)}

    shapes = {node for _, node in own if isinstance(node, mi.Shape)}
    shining = {emitter.get_shape() for emitter in emitters} - {None}
    return dict(zip(PARTS, map(names, (shapes, below(emitters) | shining, below(scene.sensors()))), strict=True))

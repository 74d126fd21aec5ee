"""Parameters of places and directions: motions of shapes, lights and cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ..jit.types import Float, Matrix4f
from ..rendering.renderer import Renderer
from .motions import host_matrix, rotation, scaling, translation
from .parameters import Scale
from .scene_change import SceneChange
from .vary import Vary

Array = npt.NDArray[np.float64]

_DEGREES = 180 / np.pi
_MOTIONS = {
    **{f"r{axis}": f"rotation {axis}" for axis in "xyz"},
    **{f"t{axis}": f"translation {axis}" for axis in "xyz"},
    "s": "scale",
    "a": "turn 1",
    "b": "turn 2",
}
_CAMERA = {"rx": "tilt", "ry": "pan", "rz": "roll"}


@dataclass(frozen=True)
class _Motion:
    """Motion of something.

    ``extent``: length that a number of one moves it. ``parts``: meanings of the numbers: rotations rx, ry, rz; turns a, b of a
    direction; translations tx, ty, tz; a scale s.
    """

    vary: Vary
    extent: float
    parts: tuple[str, ...]

    @property
    def natural(self) -> tuple[float, float]:
        return -np.inf, np.inf

    @property
    def kind(self) -> str:
        turns, moves = any(p[0] in "rab" for p in self.parts), any(p[0] == "t" for p in self.parts)
        if self.parts == ("a", "b"):
            return "direction"
        return "scale" if "s" in self.parts else "pose" if turns and moves else "rotation" if turns else "translation"

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(_MOTIONS[part] for part in self.parts)

    @property
    def units(self) -> tuple[str, ...]:
        return tuple({"t": "units", "s": "times"}.get(part[0], "deg") for part in self.parts)

    @property
    def scale(self) -> Scale:
        if self.parts == ("s",):
            return Scale(np.ones(1), np.ones(1), logarithmic=True)
        return Scale(np.zeros(len(self.parts)), np.array([self.extent if p[0] == "t" else _DEGREES for p in self.parts]))


@dataclass(frozen=True)
class ShapeMotion(_Motion):
    """Motion of shapes as one body about their common middle ``pivot`` (3,).

    ``room``: half range of starts of a translation, as a share of the extent.
    """

    shapes: tuple[str, ...]
    pivot: Array
    room: float = 0.2

    @property
    def usual(self) -> Array:
        return _ranges(self.parts, 0.35, self.room)

    def put(self, numbers: Sequence[Float], change: SceneChange) -> None:
        change.move(self.shapes, self._matrix(numbers, change.placements.get(self.shapes[0])))

    def _matrix(self, numbers: Sequence[Float], before: Matrix4f | None) -> Matrix4f:
        given = dict(zip(self.parts, numbers, strict=True))
        pivot = mi.Vector3f(*self.pivot.tolist())
        if before is not None:  # the pivot moves along
            moved = before @ mi.Vector4f(pivot.x, pivot.y, pivot.z, 1)
            pivot = mi.Vector3f(moved.x, moved.y, moved.z)
        linear = rotation(_vector(given, "r")) if self.parts[0][0] != "s" else scaling(dr.exp(given["s"]))
        return translation(pivot + _vector(given, "t") * self.extent) @ linear @ translation(-pivot)

    def arrays(self, renderer: Renderer, change: SceneChange) -> dict[str, Array]:
        matrix = host_matrix(change.placements[self.shapes[0]])
        return {"matrix": matrix, "position": (matrix @ [*self.pivot, 1])[:3], "pivot": self.pivot, "axes": np.eye(3)}


@dataclass(frozen=True)
class LightMotion(_Motion):
    """Motion of a light, named ``light``: turning about its own place and axes, and translation in world space.

    ``turns``: two axes perpendicular to its direction, of the parts a and b.
    """

    light: str
    turns: tuple[Array, Array]

    @property
    def usual(self) -> Array:
        return _ranges(self.parts, 0.4, 0.2)

    def put(self, numbers: Sequence[Float], change: SceneChange) -> None:
        given, record = dict(zip(self.parts, numbers, strict=True)), change.light(self.light)
        move = _vector(given, "t") * self.extent
        turn = mi.Vector3f(0)
        for part, axis in zip("ab", self.turns, strict=True):
            if part in given:
                turn += mi.Vector3f(*axis.tolist()) * given[part]
        if hasattr(record, "to_world"):
            own = mi.Matrix4f(record.to_world.matrix)
            place = mi.Vector3f(own[0, 3], own[1, 3], own[2, 3])
            turned = own @ rotation(_vector(given, "r"))
            if "a" in given:
                turned = translation(place) @ rotation(turn) @ translation(-place) @ turned
            new = replace(record, to_world=mi.Transform4f(translation(move) @ turned))
        elif "a" in given:
            linear = mi.Matrix3f(rotation(turn))
            new = replace(record, direction=linear @ mi.Vector3f(record.direction))
        else:
            new = replace(record, position=mi.Point3f(record.position + move))
        change.lights[self.light] = new

    def arrays(self, renderer: Renderer, change: SceneChange) -> dict[str, Array]:
        old: Any = renderer.light(self.light)  # Any: one of several records
        new, found = change.light(self.light), dict[str, Array]()
        for name in ("direction", "position"):
            if hasattr(new, name):
                found[name] = np.array(dr.detach(getattr(new, name)), np.float64).ravel()[:3]
        if hasattr(new, "to_world"):
            found["to_world"] = host_matrix(new.to_world)
            before = host_matrix(old.to_world)
            found |= {"matrix": found["to_world"] @ np.linalg.inv(before), "pivot": before[:3, 3], "axes": before[:3, :3]}
        return found


@dataclass(frozen=True)
class CameraMotion(_Motion):
    """Motion of a sensor: turning about its own axes (x to the left, y up, z forwards), and translation in world space.

    ``distance``: of the point about which it turns, straight ahead. Zero: about its own place. A camera that goes around what it
    sees keeps it in view.
    """

    sensor: int
    distance: float = 0.0

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(_CAMERA.get(part, label) for part, label in zip(self.parts, super().labels, strict=True))

    @property
    def usual(self) -> Array:
        return _ranges(self.parts, 0.3 if self.distance else 0.15, 0.15)

    def put(self, numbers: Sequence[Float], change: SceneChange) -> None:
        given, record = dict(zip(self.parts, numbers, strict=True)), change.camera(self.sensor)
        ahead = translation(mi.Vector3f(0, 0, self.distance))
        back = translation(mi.Vector3f(0, 0, -self.distance))
        move = translation(_vector(given, "t") * self.extent)
        matrix = move @ mi.Matrix4f(record.to_world.matrix) @ ahead @ rotation(_vector(given, "r")) @ back
        change.cameras[self.sensor] = replace(record, to_world=mi.Transform4f(matrix))

    def arrays(self, renderer: Renderer, change: SceneChange) -> dict[str, Array]:
        old, new = (
            host_matrix(camera.to_world) for camera in (renderer.data.cameras(self.sensor)[0], change.camera(self.sensor))
        )
        pivot = old[:3, 3] + self.distance * old[:3, 2]
        turns = {"pivot": pivot, "axes": old[:3, :3] / np.linalg.norm(old[:3, :3], axis=0)}
        return {"to_world": new, "matrix": new @ np.linalg.inv(old), "position": new[:3, 3], **turns}


def _ranges(parts: Sequence[str], turn: float, move: float) -> Array:
    """Half ranges of turns and scales, and of translations."""
    return np.array([move if part[0] == "t" else turn for part in parts])


def _vector(given: dict[str, Float], kind: str) -> Any:  # Any: mi.Vector3f
    return mi.Vector3f(*(given.get(f"{kind}{axis}", mi.Float(0)) for axis in "xyz"))

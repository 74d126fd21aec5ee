"""Parameters of a scene that few numbers describe: placements, directions, angles of view, colours.

A fit's numbers are zero in the scene as it was given, and about one where much has changed: radians, shares of an extent,
logarithms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ..jit.types import Float, Matrix4f
from ..rendering.renderer import Renderer
from ..scene.lights.read import Light
from ..scene.sensor import Sensor
from .motions import host_matrix, rotation, scaling, translation
from .vary import Vary

Array = npt.NDArray[np.float64]

_DEGREES = 180 / np.pi


@dataclass
class SceneChange:
    """The changes that the numbers of a fit make to a scene, before an image is rendered.

    Attributes:
        renderer: the renderer of the scene as it was given.
        placements: affine maps of shapes, in the order of their application.
        lights: changed records of lights.
        cameras: changed records of sensors, by number.
        values: numbers of Mitsuba's parameters by their names in ``mi.traverse``.
        arrays: (values, shape) of Mitsuba's arrays by their names.
        vertices: world-space vertices of meshes, before they are moved.
    """

    renderer: Renderer
    placements: dict[str, Matrix4f] = field(default_factory=dict)
    lights: dict[str, Light] = field(default_factory=dict)
    cameras: dict[int, Sensor] = field(default_factory=dict)
    values: dict[str, list[Float]] = field(default_factory=dict)
    arrays: dict[str, tuple[Float, tuple[int, ...]]] = field(default_factory=dict)
    vertices: dict[str, Float] = field(default_factory=dict)

    def light(self, name: str) -> Any:  # Any: one of several records
        """The current record of a light."""
        return self.lights.get(name, self.renderer.light(name))

    def camera(self, number: int) -> Sensor:
        """The current record of a sensor."""
        return self.cameras.get(number, self.renderer.data.cameras(number)[0])

    def move(self, shapes: Sequence[str], matrix: Matrix4f) -> None:
        """Move shapes by an affine map, after the maps that they have."""
        for name in shapes:
            self.placements[name] = matrix @ self.placements[name] if name in self.placements else matrix


@dataclass(frozen=True)
class Scale:
    """Relation between a fit's numbers x and the numbers that users read: offset + factor x, or offset exp(x).

    Attributes:
        offset: the scene's values, (n,).
        factor: units for a change of x by one, (n,).
        logarithmic: True for values that stay positive.
    """

    offset: Array
    factor: Array
    logarithmic: bool = False

    def shown(self, x: npt.ArrayLike) -> Array:
        """Values (n,) in units."""
        x = np.asarray(x, np.float64)
        return self.offset * np.exp(x) if self.logarithmic else self.offset + self.factor * x

    def widths(self, x: npt.ArrayLike, half: npt.ArrayLike) -> Array:
        """Half-widths (n,) in units of intervals about x."""
        return np.abs(self.shown(x) if self.logarithmic else self.factor) * np.asarray(half, np.float64)

    def number(self, value: float) -> Array:
        """The fit's numbers (n,) of a value in units; minus infinity for a bound of zero or less of positive values."""
        if not self.logarithmic:
            return np.asarray((value - self.offset) / self.factor)
        return np.log(np.maximum(value, 1e-300) / self.offset) if value > 0 else np.full(len(self.offset), -np.inf)


class Parameter(Protocol):
    """One entry of the list of things that vary, with n numbers.

    ``labels``, ``units``: of each number, for reports; ``scale``: units of the numbers; ``natural``: bounds (low, high) in units,
    from the meaning of the values; ``usual``: half ranges (n,) of starts, in the fit's own numbers.
    """

    @property
    def vary(self) -> Vary: ...

    @property
    def natural(self) -> tuple[float, float]: ...

    @property
    def kind(self) -> str: ...

    @property
    def labels(self) -> tuple[str, ...]: ...

    @property
    def units(self) -> tuple[str, ...]: ...

    @property
    def scale(self) -> Scale: ...

    @property
    def usual(self) -> Array: ...

    def put(self, numbers: Sequence[Float], change: SceneChange) -> None:
        """Write the change of numbers (Float of width 1 each, attached) into a :class:`SceneChange`."""

    def arrays(self, renderer: Renderer, change: SceneChange) -> dict[str, Array]:
        """Values for records and files, detached."""


@dataclass(frozen=True)
class ShapeMotion:
    """Motion of shapes as one body about their common middle ``pivot`` (3,); ``extent``: length that a number of one moves them.

    ``room``: half range of starts of a translation, as a share of the extent.

    ``parts``: the numbers' meanings: rx, ry, rz, tx, ty, tz, s.
    """

    vary: Vary
    shapes: tuple[str, ...]
    pivot: Array
    extent: float
    parts: tuple[str, ...]
    room: float = 0.2
    natural: tuple[float, float] = (-np.inf, np.inf)

    @property
    def kind(self) -> str:
        return _kind(self.parts)

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(_MOTIONS[part] for part in self.parts)

    @property
    def units(self) -> tuple[str, ...]:
        return tuple({"r": "deg", "t": "units", "s": "times"}[part[0]] for part in self.parts)

    @property
    def scale(self) -> Scale:
        if self.parts == ("s",):
            return Scale(np.ones(1), np.ones(1), logarithmic=True)
        return Scale(np.zeros(len(self.parts)), np.array([_DEGREES if p[0] == "r" else self.extent for p in self.parts]))

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
class LightMotion:
    """Motion of a light, named ``light``: turning about its own place, and translation in world space.

    ``parts``: a, b (turns of its direction about two axes perpendicular to it), rx, ry, rz (about its own axes), tx, ty, tz.
    """

    vary: Vary
    light: str
    extent: float
    parts: tuple[str, ...]
    turns: tuple[Array, Array]
    natural: tuple[float, float] = (-np.inf, np.inf)

    @property
    def kind(self) -> str:
        return _kind(self.parts)

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(_MOTIONS[part] for part in self.parts)

    @property
    def units(self) -> tuple[str, ...]:
        return tuple("units" if part[0] == "t" else "deg" for part in self.parts)

    @property
    def scale(self) -> Scale:
        return Scale(np.zeros(len(self.parts)), np.array([self.extent if p[0] == "t" else _DEGREES for p in self.parts]))

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
class CameraMotion:
    """Motion of a sensor: turning about its own axes (x to the left, y up, z forwards), and translation in world space.

    ``distance``: of the point about which it turns, straight ahead. Zero: about its own place. A camera that goes around what it
    sees keeps it in view.
    """

    vary: Vary
    sensor: int
    extent: float
    parts: tuple[str, ...]
    distance: float = 0.0
    natural: tuple[float, float] = (-np.inf, np.inf)

    @property
    def kind(self) -> str:
        return _kind(self.parts)

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(_CAMERA.get(part, _MOTIONS[part]) for part in self.parts)

    @property
    def units(self) -> tuple[str, ...]:
        return tuple("units" if part[0] == "t" else "deg" for part in self.parts)

    @property
    def scale(self) -> Scale:
        return Scale(np.zeros(len(self.parts)), np.array([self.extent if p[0] == "t" else _DEGREES for p in self.parts]))

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


@dataclass(frozen=True)
class FieldOfView:
    """Horizontal angle of view of a sensor; ``degrees``: the scene's."""

    vary: Vary
    sensor: int
    degrees: float
    natural: tuple[float, float] = (1.0, 170.0)
    labels: tuple[str, ...] = ("angle of view",)
    units: tuple[str, ...] = ("deg",)
    kind: str = "fov"

    @property
    def scale(self) -> Scale:
        return Scale(np.array([self.degrees]), np.array([self.degrees]), logarithmic=True)

    @property
    def usual(self) -> Array:
        return np.array([0.15])

    def put(self, numbers: Sequence[Float], change: SceneChange) -> None:
        record = change.camera(self.sensor)
        change.cameras[self.sensor] = replace(record, x_fov=record.x_fov * dr.exp(numbers[0]))

    def arrays(self, renderer: Renderer, change: SceneChange) -> dict[str, Array]:
        return {"value": np.array(dr.detach(change.camera(self.sensor).x_fov), np.float64)}


@dataclass(frozen=True)
class Value:
    """A colour or number: of Mitsuba's parameter ``key``, or of the ``field`` of the record of a light, if that is not "".

    ``start`` (n,); ``common``: one number, a factor of all values; ``logarithmic``: values stay positive.
    """

    vary: Vary
    key: str
    start: Array
    natural: tuple[float, float]
    logarithmic: bool
    light: str = ""
    field: str = ""
    common: bool = False
    unit: str = ""
    kind: str = "value"

    @property
    def labels(self) -> tuple[str, ...]:
        if self.common:
            return ("factor",)
        return ("red", "green", "blue") if len(self.start) == 3 else ("value",) if len(self.start) == 1 else _numbered(self.start)

    @property
    def units(self) -> tuple[str, ...]:
        return ("times",) if self.common else (self.unit,) * len(self.start)

    @property
    def scale(self) -> Scale:
        if self.common:
            return Scale(np.ones(1), np.ones(1), logarithmic=True)
        if self.logarithmic:
            return Scale(self.start, self.start, logarithmic=True)
        size = self.natural[1] - self.natural[0]
        return Scale(
            self.start, np.full(len(self.start), size if np.isfinite(size) else max(1.0, float(np.abs(self.start).max())))
        )

    @property
    def usual(self) -> Array:
        return np.full(len(self.labels), 0.5 if self.scale.logarithmic else 0.25)

    def put(self, numbers: Sequence[Float], change: SceneChange) -> None:
        scale, each = self.scale, (numbers[0],) * len(self.start) if self.common else numbers
        if self.common or self.logarithmic:
            parts = [float(start) * dr.exp(x) for start, x in zip(self.start, each, strict=True)]
        else:
            parts = [float(start) + float(factor) * x for start, factor, x in zip(self.start, scale.factor, each, strict=True)]
        if self.light:
            value = type(getattr(change.light(self.light), self.field))(*parts)
            change.lights[self.light] = replace(change.light(self.light), **{self.field: value})
        else:
            change.values[self.key] = parts

    def arrays(self, renderer: Renderer, change: SceneChange) -> dict[str, Array]:
        value = getattr(change.light(self.light), self.field) if self.light else change.values[self.key]
        if not self.light:
            return {"value": np.array([float(dr.detach(one)[0]) for one in value])}
        return {"value": np.array(dr.detach(value), np.float64).ravel()}


_MOTIONS = {
    **{f"r{axis}": f"rotation {axis}" for axis in "xyz"},
    **{f"t{axis}": f"translation {axis}" for axis in "xyz"},
    "s": "scale",
    "a": "turn 1",
    "b": "turn 2",
}
_CAMERA = {"rx": "tilt", "ry": "pan", "rz": "roll"}


def _kind(parts: Sequence[str]) -> str:
    turns, moves = any(p[0] in "rab" for p in parts), any(p[0] == "t" for p in parts)
    if parts == ("a", "b"):
        return "direction"
    return "scale" if "s" in parts else "pose" if turns and moves else "rotation" if turns else "translation"


def _ranges(parts: Sequence[str], turn: float, move: float) -> Array:
    """Half ranges of turns and scales, and of translations."""
    return np.array([move if part[0] == "t" else turn for part in parts])


def _numbered(values: Array) -> tuple[str, ...]:
    return tuple(f"value {k}" for k in range(len(values)))


def _vector(given: dict[str, Float], kind: str) -> Any:  # Any: mi.Vector3f
    return mi.Vector3f(*(given.get(f"{kind}{axis}", mi.Float(0)) for axis in "xyz"))

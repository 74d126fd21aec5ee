"""Parameters of a scene by the names that users write."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError, did_you_mean, quoted, shortened
from ..rendering.renderer import Renderer
from ..scene.naming import name_objects
from .arrays import ArrayParameter, MeshVertices, TextureValues, has_vertices, mesh_vertices, texture_values
from .motion_parameters import CameraMotion, LightMotion, ShapeMotion
from .motions import host_matrix, tangents
from .own import Own
from .parameters import FieldOfView, Parameter, Value, is_roughness, is_share
from .vary import Vary

Array = npt.NDArray[np.float64]

# Fields of lights' records by the ends of Mitsuba's names.
_FIELDS = {
    "irradiance.value": "irradiance",
    "intensity.value": "intensity",
    "cutoff_angle": "cutoff_angle",
    "beam_width": "beam_width",
}
# Half range of starts of a translation: as a share of the scene's diameter; least and most as shares of the shape's.
_ROOM, _LEAST_MOST = 0.08, (0.15, 0.5)
# Most numbers of one value that are fitted by their full matrix of derivatives.
_MOST = 16


@dataclass(frozen=True)
class Candidate:
    """An object or value of a scene that can vary: its name, its kinds, and its present value in words."""

    name: str
    kinds: tuple[str, ...]
    value: str


class Resolver:
    """The objects and values of one scene by name. Objects without an id get one.

    Args:
        renderer: the renderer of the scene.
    """

    def __init__(self, renderer: Renderer) -> None:
        self.renderer = renderer
        self.shapes = [info.name for info in renderer.data.geometry.shapes]
        self.lights = [light.name for light in renderer.data.lights]
        self.sensors = {cameras[0].name: k for k, cameras in enumerate(renderer.data.sensors) if len(cameras) == 1}
        name_objects(renderer.data.scene)
        self.table = mi.traverse(renderer.data.scene)
        # Names alone: to list a table loads values, which may be large.
        self.keys = list(self.table.properties)
        with dr.suspend_grad():
            points = np.array(dr.detach(renderer.data.geometry.positions)).reshape(-1, 3).astype(np.float64)
        self._points = points
        self.middle, self.diameter = _bounds(points)

    def parameter(self, vary: Vary) -> Parameter | MeshVertices | TextureValues:
        """The parameter of an entry.

        Raises:
            ShadowmapError: The scene has no such object or value, or it has no such kind; with the nearest known name.
        """
        name = vary.name
        matched = self._matched(vary)
        if vary.kind == "vertices":
            if len(matched) != 1:
                raise ShadowmapError(f"{vary.named}: {len(matched)} shapes are called {quoted(name)}; name one mesh.")
            return mesh_vertices(self.renderer, vary, matched[0])
        if vary.kind == "texture":
            return texture_values(self.renderer, vary, self._texture_key(vary))
        if vary.kind in ("value", "brightness", "sky") or not (matched or name in self.lights or name in self.sensors):
            return self._value(vary)
        found = self._shape(vary, matched) if matched else self._light(vary) if name in self.lights else self._sensor(vary)
        given = [name for name in ("min", "max", "prior", "spread") if name in vary.plain()]
        if found.kind == "pose" and given:
            raise ShadowmapError(
                f"{vary.named}: {given[0]} is one number, but a pose has degrees and scene units: give "
                f"{shortened(name)}:rotation and {shortened(name)}:translation, each with its own."
            )
        return found

    def _matched(self, vary: Vary) -> list[str]:
        """Shapes that a name stands for: its own, or those of `a+b` or `a*`, which move together."""
        patterns = [vary.name] if vary.name in self.shapes else vary.name.split("+")
        found = [shape for shape in self.shapes if any(shape == name or fnmatchcase(shape, name) for name in patterns)]
        for name in patterns:
            if found and not any(shape == name or fnmatchcase(shape, name) for shape in found):
                raise ShadowmapError(f"{vary.named}: the scene has no shape {quoted(name)}; --list lists all.")
        return found

    def parameters(self, entries: Sequence[Vary | Own]) -> tuple[list[Parameter], list[ArrayParameter]]:
        """The parameters of entries: those that few numbers describe, and those with many values."""
        few: list[Parameter] = []
        many: list[ArrayParameter] = []
        known: dict[str, Vary] = {}
        for vary in entries:
            found = vary if isinstance(vary, Own) else self.parameter(vary)
            if isinstance(found, (Value, TextureValues)):
                earlier = known.setdefault(found.key, found.vary)
                if earlier is not found.vary:
                    names = f"vary {shortened(earlier.label)} and {shortened(found.vary.label)}"
                    raise ShadowmapError(f"{names}: both vary {found.key}; leave one out.")
            if isinstance(found, (MeshVertices, TextureValues)):
                many.append(found)
            else:
                few.append(found)
        return few, many

    def candidates(self) -> list[Candidate]:
        """All that can vary."""
        found = [Candidate(name, self._shape_kinds(name), "shape") for name in self.shapes]
        for light in self.renderer.data.lights:
            kinds = tuple(self._light_kinds(light))
            if kinds:
                found.append(Candidate(light.name, kinds, type(light).__name__))
        found += [Candidate(name, self._sensor_kinds(number), "camera") for name, number in self.sensors.items()]
        for key in self.keys:
            array = self._numbers(key)
            if array is not None:
                kind = ("value", "brightness") if len(array) == 3 else ("value",)
                found.append(Candidate(key, ("texture",) if self._is_texture(key, array) else kind, _shown(array)))
        return found

    # ------------------------------------------------------------------------------------------------------ shapes

    def _shape_kinds(self, name: str) -> tuple[str, ...]:
        return ("pose", "rotation", "translation", "scale", *(["vertices"] if has_vertices(self.renderer, name) else []))

    def _shape(self, vary: Vary, shapes: Sequence[str]) -> Parameter:
        parts = {**_rigid_parts(vary.axes), "scale": ("s",)}.get(vary.kind or "pose")
        if parts is None:
            raise _no_kind(vary, "a shape", self._shape_kinds(shapes[0]))
        infos = [self.renderer.data.geometry.shape(shape) for shape in shapes]
        points = np.concatenate([self._points[info.vertex_start : info.vertex_start + info.vertex_count] for info in infos])
        middle, diameter = _bounds(points)
        extent = diameter or self.diameter
        room = float(np.clip(_ROOM * self.diameter / extent, *_LEAST_MOST))
        return ShapeMotion(vary, extent, parts, tuple(shapes), middle, room)

    # ------------------------------------------------------------------------------------------------------ lights, sensors

    def _light_kinds(self, light: Any) -> list[str]:  # Any: one of several records
        placed = hasattr(light, "to_world")
        return [
            *(["pose", "rotation"] if placed else []),
            *(["direction"] if hasattr(light, "direction") else []),
            *(["position"] if placed or hasattr(light, "position") else []),
        ]

    def _light(self, vary: Vary) -> Parameter:
        light: Any = self.renderer.light(vary.name)  # Any: one of several records
        kinds = self._light_kinds(light)
        kind = {"translation": "position"}.get(vary.kind, vary.kind) or (kinds[0] if len(kinds) == 1 else "")
        if not kind and kinds:
            kind = "direction" if kinds == ["direction"] else "pose"
        if kind not in kinds:
            raise _no_kind(vary, f"a {type(light).__name__}", (*kinds, "brightness"))
        # The turn of a spot light without picture about its own axis changes nothing.
        is_round = hasattr(light, "cutoff_angle") and light.texture is None
        parts = {**_rigid_parts(vary.axes), "direction": ("a", "b")}[kind]
        if kind == "pose" and is_round:
            parts = ("a", "b", "tx", "ty", "tz")
        direction = (
            np.array(dr.detach(light.direction), np.float64).ravel() if hasattr(light, "direction") else np.array([0, 0, 1.0])
        )
        extent = self.diameter
        if hasattr(light, "position"):
            extent = float(np.linalg.norm(np.array(dr.detach(light.position), np.float64).ravel() - self.middle)) or self.diameter
        return LightMotion(vary, extent, parts, vary.name, tangents(direction))

    def _sensor_kinds(self, number: int) -> tuple[str, ...]:
        perspective = self.renderer.data.cameras(number)[0].kind == "perspective"
        return ("pose", "rotation", "translation", *(["fov"] if perspective else []))

    def _sensor(self, vary: Vary) -> Parameter:
        number, kind = self.sensors[vary.name], vary.kind or "pose"
        record = self.renderer.data.cameras(number)[0]
        if kind == "fov":
            if record.kind != "perspective":
                raise ShadowmapError(f"{vary.named}: the sensor is orthographic and has no angle of view.")
            return FieldOfView(vary, number, float(dr.detach(record.x_fov)[0]))
        parts = _rigid_parts(vary.axes).get(kind)
        if parts is None:
            raise _no_kind(vary, "a camera", self._sensor_kinds(number))
        place, towards = (np.array(dr.detach(v), np.float64).ravel() for v in (record.origin, record.direction))
        away = float(np.linalg.norm(place - self.middle)) or self.diameter
        ahead = max(float(towards @ (self.middle - place)), 0.1 * away) if kind == "pose" else 0.0
        # The distance is one of the camera's own space, which may be scaled.
        scale = float(np.linalg.norm(host_matrix(record.to_world)[:3, 2]))
        return CameraMotion(vary, away, parts, number, ahead / scale)

    # ------------------------------------------------------------------------------------------------------ values

    def _value(self, vary: Vary) -> Parameter:
        key = self._key(vary)
        light, _, field = key.partition(".")
        if field == "position" and light in self.lights:
            raise ShadowmapError(f"{vary.named}: the position of a light is a kind of it: give {light}:position.")
        array = self._numbers(key)
        if array is None:
            raise ShadowmapError(f"{vary.named}: {key} is a {type(self.table[key]).__name__}, to which no derivatives flow.")
        common = vary.kind in ("brightness", "sky")
        if vary.kind not in ("", "value", "brightness", "sky"):
            raise _no_kind(vary, "a value", ("value", "brightness"))
        if self._is_texture(key, array):
            raise ShadowmapError(f"{vary.named}: {key} has {len(array)} values; give the kind texture.")
        owner, _, end = key.partition(".")
        light = owner if owner in self.lights and end in _FIELDS else ""
        natural = (0.0, np.inf)
        if end in ("cutoff_angle", "beam_width"):
            natural = (0.1, 179.0)
        elif is_roughness(key):
            natural = (1e-3, 1.0)
        elif is_share(key):
            natural = (0.0, 1.0)
        elif not (array > 0).all():
            natural = (-np.inf, np.inf)
        if common and not (array.max() > 0):
            raise ShadowmapError(
                f"{vary.named}: {key} is {_shown(array)}; a factor of zero changes nothing: give the kind value."
            )
        logarithmic = not common and natural == (0.0, np.inf) or natural == (0.1, 179.0)
        bounds = (0.0, np.inf) if common else natural
        unit = "deg" if end in ("cutoff_angle", "beam_width") else ""
        return Value(vary, key, array, bounds, logarithmic, light, _FIELDS[end] if light else "", common, unit=unit)

    def _key(self, vary: Vary) -> str:
        """Mitsuba's name of the value of an entry."""
        name = vary.name
        tried = [name, f"{name}.value"]
        if vary.kind in ("brightness", "sky", "value"):
            tried += [f"{name}.{end}" for end in ("irradiance.value", "intensity.value", "radiance.value", "scale")]
            tried += [f"{name}.emitter.radiance.value", f"{name}.bsdf.reflectance.value"]
        for key in tried:
            if key in self.keys:
                return key
        known = [*self.shapes, *self.lights, *self.sensors, *(key.removesuffix(".value") for key in self.keys)]
        parts = [shape for shape in self.shapes if shape.startswith(f"{name}.")]
        near = f" Did you mean its parts, '{name}.*'?" if parts else did_you_mean(name, known)
        raise ShadowmapError(f"{vary.named}: the scene has no object or value {quoted(name)}; --list lists all.{near}")

    def _texture_key(self, vary: Vary) -> str:
        """Mitsuba's name of the array of an entry: itself, or the only one of a material or light."""
        own = [key for key in self.keys if key == vary.name or key.startswith(f"{vary.name}.")]
        arrays = [key for key in own if (array := self._numbers(key)) is not None and self._is_texture(key, array)]
        if len(arrays) == 1:
            return arrays[0]
        if arrays:
            raise ShadowmapError(f"{vary.named}: there are several, {shortened(', '.join(arrays), 160)}; name one.")
        coarse = [key for key in own if key.endswith(".data") and not dr.is_float_v(self.table[key])]
        if coarse:
            raise ShadowmapError(
                f"{vary.named}: {coarse[0]} holds whole numbers, to which no derivatives flow: give the scene's file "
                "instead of the scene, or the texture 'format': 'variant'."
            )
        known = [key for key in self.keys if key.endswith(".data")]
        near = did_you_mean(vary.name, known)
        raise ShadowmapError(
            f"{vary.named}: {quoted(vary.name)} has no texture; textures: {shortened(', '.join(known), 160) or 'none'}.{near}"
        )

    def _is_texture(self, key: str, array: Array) -> bool:
        """True for pictures, however small, and for arrays of more numbers than a full matrix of derivatives serves."""
        return len(array) > _MOST or dr.is_tensor_v(self.table[key])

    def _numbers(self, key: str) -> Array | None:
        """The values (n,) of a parameter of Mitsuba's; None if no derivatives flow to it, and for parts of meshes and films."""
        if key.endswith((".faces", ".vertex_positions", ".vertex_normals", ".vertex_texcoords", ".to_world", ".to_uv", ".x_fov")):
            return None
        if any(key.startswith(f"{name}.") for name in self.sensors) or key in [f"{light}.position" for light in self.lights]:
            return None
        value = self.table[key]
        if not (dr.is_array_v(value) and dr.is_float_v(value) and dr.is_diff_v(value)):  # transformations are no arrays
            return None
        return np.array(dr.detach(value), np.float64).ravel()


def _rigid_parts(axes: str) -> dict[str, tuple[str, ...]]:
    """Parts of rotations and translations, by kind. ``axes``: of those that have some; all if empty."""
    turns, moves = (tuple(f"{letter}{axis}" for axis in axes or "xyz") for letter in "rt")
    return {"pose": ("rx", "ry", "rz", "tx", "ty", "tz"), "rotation": turns, "translation": moves, "position": moves}


def _bounds(points: Array) -> tuple[Array, float]:
    """(middle, diagonal) of the bounding box of points (N, 3)."""
    finite = points[np.isfinite(points).all(1)]
    low, high = finite.min(0), finite.max(0)
    return 0.5 * (low + high), float(np.linalg.norm(high - low))


def _no_kind(vary: Vary, what: str, kinds: Sequence[str]) -> ShadowmapError:
    return ShadowmapError(f"{vary.named}: {quoted(vary.name)} is {what} and has the kinds {', '.join(kinds)}.")


def _shown(values: Array) -> str:
    text = ", ".join(f"{value:.4g}" for value in values[:4])
    return text if len(values) <= 4 else f"{len(values):,} values"

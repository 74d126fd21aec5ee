"""A Mitsuba scene of a model: an XML file, and a folder beside it with meshes (PLY) and pictures (PNG)."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as Xml

import numpy as np

from ..io.files import atomic, make_folder
from ..io.images import to_linear, to_srgb
from .model import Array, Material, Model, Part, Picture, PlacedCamera, PlacedLight
from .options import ImportOptions

# Angle of view of the camera that a model without one gets, degrees.
_FOV = 35.0
# Direction from which that camera looks, for each axis that points upwards.
_FROM = {"y": (0.55, 0.4, 1.0), "z": (0.55, -1.0, 0.4)}
_UP = {"y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
# Direction of the light that a model without one gets, from it to the model, and irradiances of it and of the sky around.
_SUN = {"y": (-0.6, -1.0, -0.4), "z": (-0.6, 0.4, -1.0)}
_SUNLIGHT, _SKYLIGHT = 2.5, 0.3


@dataclass
class Written:
    """Results of :func:`write_scene`: the files, and notes about additions and changed names."""

    files: list[Path] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def write_scene(model: Model, path: Path, options: ImportOptions) -> Written:
    """Write a scene that Mitsuba loads.

    Args:
        model: all that the scene has. Without a camera it gets one that sees all.
        path: of the XML file. Meshes and pictures go into the folder ``<its name>_files`` beside it.
        options: additions, and the size of pictures.

    Raises:
        OutputError: A file could not be written.
    """
    return _Writer(path, options).write(model)


class _Writer:
    def __init__(self, path: Path, options: ImportOptions) -> None:
        self.path, self.options, self.up, self.longer_side = path, options, options.up, options.size
        self.folder = path.with_name(f"{path.stem}_files")
        self.written, self.ids, self.named = Written(), set[str](), dict[int, str]()
        self.renamed: list[tuple[str, str]] = []

    def write(self, model: Model) -> Written:
        make_folder(self.folder)
        root = Xml.Element("scene", version="3.0.0")
        root.append(Xml.Element("integrator", type="direct"))
        cameras = model.cameras or (self._camera_around(model),)
        for camera in cameras:
            root.append(self._sensor(camera, model))
        for light in model.lights:
            root.append(self._emitter(light))
        if self.options.daylight and not model.lights:
            self._daylight(root)
        for part in model.parts:
            if part.material is not None and part.colours is None and id(part.material) not in self.named:
                root.append(self._bsdf(part.material))
            root.append(self._shape(part))
        if self.options.floor:
            root.append(self._floor(model))
        if self.renamed:
            first = ", ".join(f"{old!r} is {new!r}" for old, new in self.renamed[:3])
            more = f", and {len(self.renamed) - 3} more" if len(self.renamed) > 3 else ""
            self.written.notes.append(f"names that Mitsuba does not take, or that were there twice, are others: {first}{more}")
        Xml.indent(root, "    ")
        with atomic(self.path) as temporary:
            Xml.ElementTree(root).write(temporary, encoding="utf-8", xml_declaration=True)
        self.written.files.insert(0, self.path)
        return self.written

    # ------------------------------------------------------------------------------------------------------- cameras, lights

    def _camera_around(self, model: Model) -> PlacedCamera:
        low, high = model.bounds
        middle, back = 0.5 * (low + high), np.array(_FROM[self.up]) / np.linalg.norm(_FROM[self.up])
        to_world = _looking(middle, -back, np.array(_UP[self.up]))
        # As near as all vertices allow that lie within the cone of view, with a margin.
        across, depth = math.tan(math.radians(0.5 * _FOV)), 0.0
        for part in model.parts:
            seen = (part.vertices - middle) @ to_world[:3, :3]
            depth = max(depth, float((np.abs(seen[:, :2]).max(1) / across - seen[:, 2]).max()))
        to_world[:3, 3] += 1.1 * (depth or 1.0) * back
        self.written.notes.append("the file has no camera: one was added that sees all of it")
        return PlacedCamera("camera", to_world, _FOV, 1.0)

    def _sensor(self, camera: PlacedCamera, model: Model) -> Xml.Element:
        low, high = model.bounds
        far = float(np.linalg.norm(high - low) + np.abs(camera.to_world[:3, 3] - 0.5 * (low + high)).max() * 2)
        width = min(1.0, camera.aspect) * self.longer_side, min(1.0, 1 / camera.aspect) * self.longer_side
        columns, rows = (max(1, round(side)) for side in width)
        values: dict[str, Any] = {"near_clip": 1e-4 * far, "far_clip": 10 * far}
        matrix = camera.to_world
        if camera.fov is not None:
            values |= {"fov": camera.fov, "fov_axis": "y"}
        else:
            matrix = matrix @ np.diag([0.5 * (camera.height or 1) * camera.aspect] * 2 + [1.0, 1.0])
        sensor = _element("sensor", "orthographic" if camera.fov is None else "perspective", self._id(camera.name), values)
        sensor.append(_transform(matrix))
        sensor.append(_element("sampler", "independent", None, {"sample_count": 64}))
        film = _element("film", "hdrfilm", None, {"width": columns, "height": rows, "pixel_format": "rgb"})
        film.append(Xml.Element("rfilter", type="box"))
        sensor.append(film)
        return sensor

    def _emitter(self, light: PlacedLight) -> Xml.Element:
        if light.kind == "directional":
            emitter = _element("emitter", "directional", self._id(light.name), {"irradiance": light.colour})
            emitter.append(_vector("direction", light.direction))
        elif light.kind == "point":
            emitter = _element("emitter", "point", self._id(light.name), {"intensity": light.colour})
            emitter.append(_vector("position", light.place, "point"))
        else:
            inner, outer = light.cone
            values = {"intensity": light.colour, "cutoff_angle": outer, "beam_width": min(inner, outer)}
            emitter = _element("emitter", "spot", self._id(light.name), values)
            emitter.append(_transform(_looking(light.place, light.direction, np.array(_UP[self.up]))))
        return emitter

    def _daylight(self, root: Xml.Element) -> None:
        sun = _element("emitter", "directional", self._id("sun"), {"irradiance": np.full(3, _SUNLIGHT)})
        sun.append(_vector("direction", _SUN[self.up]))
        root.append(sun)
        root.append(_element("emitter", "constant", self._id("sky"), {"radiance": np.full(3, _SKYLIGHT)}))
        self.written.notes.append("the file has no light: a sun and a dim sky were added")

    def _floor(self, model: Model) -> Xml.Element:
        """A square below the model, three times as wide as it is."""
        low, high = model.bounds
        axis = 1 if self.up == "y" else 2
        middle, half = 0.5 * (low + high), 1.5 * float(np.linalg.norm(high - low))
        middle[axis] = low[axis]
        matrix = np.eye(4)
        # A rectangle faces +z.
        matrix[:3, :3] = half * (np.eye(3) if axis == 2 else np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]))
        matrix[:3, 3] = middle
        floor = _element("shape", "rectangle", self._id("floor"), {})
        floor.append(_transform(matrix))
        floor.append(_two_sided(_element("bsdf", "diffuse", None, {"reflectance": np.full(3, 0.5)})))
        self.written.notes.append("a floor was added")
        return floor

    # ------------------------------------------------------------------------------------------------------ meshes, materials

    def _shape(self, part: Part) -> Xml.Element:
        from .mesh_file import write_mesh

        name = self._id(part.name)
        file = self.folder / f"{name}.ply"
        write_mesh(file, part)
        self.written.files.append(file)
        shape = _element("shape", "ply", name, {"filename": f"{self.folder.name}/{file.name}"})
        if part.normals is None and not part.smooth:
            shape.append(_value("face_normals", True))
        if part.colours is not None:
            shape.append(
                _two_sided(
                    _textured("diffuse", "reflectance", _element("texture", "mesh_attribute", None, {"name": "vertex_color"}))
                )
            )
        elif part.material is not None:
            shape.append(Xml.Element("ref", id=self.named[id(part.material)]))
            if part.material.emission.any():
                shape.append(self._glow(part.material))
        else:
            shape.append(_two_sided(_element("bsdf", "diffuse", None, {"reflectance": np.full(3, 0.5)})))
        return shape

    def _glow(self, material: Material) -> Xml.Element:
        emitter = Xml.Element("emitter", type="area")
        if material.emission_picture is None:
            emitter.append(_value("radiance", material.emission))
        else:
            picture = _multiplied(material.emission_picture, material.emission)
            emitter.append(_named("radiance", self._texture(f"{self.named[id(material)]}-emission", picture)))
        return emitter

    def _bsdf(self, material: Material) -> Xml.Element:
        name = self.named[id(material)] = self._id(material.name)
        surface = Xml.Element("bsdf", type="principled")
        if material.picture is None:
            surface.append(_value("base_color", np.clip(material.colour, 0, 1)))
        else:
            picture = _multiplied(material.picture, material.colour)
            surface.append(_named("base_color", self._texture(f"{name}-colour", picture)))
        for key, value in (("roughness", material.roughness), ("metallic", material.metallic)):
            if isinstance(value, np.ndarray):
                surface.append(_named(key, self._texture(f"{name}-{key}", value, raw=True)))
            else:
                # Mitsuba's model has no mirrors.
                surface.append(_value(key, max(float(value), 0.05) if key == "roughness" else float(value)))
        if material.normals is not None:
            mapped = Xml.Element("bsdf", type="normalmap")
            # Mitsuba's frame has the normal's green along n x dp/du: upwards, as in glTF, where no picture is mirrored.
            mapped.append(_named("normalmap", self._texture(f"{name}-normals", material.normals, raw=True)))
            mapped.append(surface)
            surface = mapped
        surface = _two_sided(surface)
        opacity = material.opacity
        if isinstance(opacity, np.ndarray) or opacity < 1 or material.cutoff is not None:
            surface = self._masked(surface, name, opacity, material.cutoff)
        surface.set("id", name)
        return surface

    def _masked(self, surface: Xml.Element, name: str, opacity: Picture | float, cutoff: float | None) -> Xml.Element:
        if cutoff is not None:
            opacity = (
                np.where(opacity >= 255 * cutoff, 255, 0).astype(np.uint8)
                if isinstance(opacity, np.ndarray)
                else float(opacity >= cutoff)
            )
        mask = Xml.Element("bsdf", type="mask")
        if isinstance(opacity, np.ndarray):
            mask.append(_named("opacity", self._texture(f"{name}-opacity", opacity, raw=True)))
        else:
            mask.append(_value("opacity", float(opacity)))
        mask.append(surface)
        return mask

    def _texture(self, name: str, picture: Picture, raw: bool = False) -> Xml.Element:
        from PIL import Image

        file = self.folder / f"{name}.png"
        with atomic(file) as temporary:
            Image.fromarray(picture).save(temporary, format="png")
        self.written.files.append(file)
        texture = _element("texture", "bitmap", None, {"filename": f"{self.folder.name}/{file.name}"})
        if raw:
            texture.append(_value("raw", True))
        return texture

    def _id(self, name: str) -> str:
        """An identifier of a file's name: Mitsuba takes no dots, file systems no slashes, and each only once."""
        base = re.sub(r"[^\w+-]+", "_", name, flags=re.ASCII).strip("_") or "unnamed"
        found, number = base, 2
        while found.lower() in self.ids:
            found, number = f"{base}_{number}", number + 1
        self.ids.add(found.lower())
        if found != name:
            self.renamed.append((name, found))
        return found


# ------------------------------------------------------------------------------------------------------------------ elements


def _element(tag: str, kind: str, name: str | None, values: Mapping[str, Any]) -> Xml.Element:
    element = Xml.Element(tag, type=kind)
    if name is not None:
        element.set("id", name)
    element.extend(_value(key, value) for key, value in values.items())
    return element


def _value(name: str, value: Any) -> Xml.Element:  # Any: a number, a word, or a colour
    if isinstance(value, bool):
        return Xml.Element("boolean", name=name, value=str(value).lower())
    if isinstance(value, str):
        return Xml.Element("string", name=name, value=value)
    if isinstance(value, int):
        return Xml.Element("integer", name=name, value=str(value))
    if isinstance(value, float):
        return Xml.Element("float", name=name, value=f"{value:.9g}")
    return Xml.Element("rgb", name=name, value=_numbers(value))


def _vector(name: str, values: Iterable[float], tag: str = "vector") -> Xml.Element:
    return Xml.Element(tag, name=name, value=_numbers(values))


def _numbers(values: Iterable[float]) -> str:
    return ", ".join(f"{float(value):.9g}" for value in values)


def _transform(matrix: Array) -> Xml.Element:
    transform = Xml.Element("transform", name="to_world")
    transform.append(Xml.Element("matrix", value=" ".join(f"{value:.9g}" for value in matrix.ravel())))
    return transform


def _named(name: str, element: Xml.Element) -> Xml.Element:
    element.set("name", name)
    return element


def _textured(kind: str, key: str, texture: Xml.Element) -> Xml.Element:
    bsdf = Xml.Element("bsdf", type=kind)
    bsdf.append(_named(key, texture))
    return bsdf


def _two_sided(bsdf: Xml.Element) -> Xml.Element:
    """Viewers show both sides of most meshes; Mitsuba's materials are black from behind."""
    both = Xml.Element("bsdf", type="twosided")
    both.append(bsdf)
    return both


def _looking(origin: Array, direction: Sequence[float] | Array, up: Array) -> Array:
    """Camera to world, (4, 4), with Mitsuba's axes: +z along ``direction``, x to the left, y up."""
    forward = np.asarray(direction, np.float64)
    forward = forward / np.linalg.norm(forward)
    left = np.cross(up, forward)
    if np.linalg.norm(left) < 1e-6:
        left = np.cross(np.roll(up, 1), forward)
    left /= np.linalg.norm(left)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.stack([left, np.cross(forward, left), forward], -1), origin
    return matrix


def _multiplied(picture: Picture, factor: Array) -> Picture:
    """An sRGB picture times a linear colour."""
    if np.allclose(factor, 1):
        return picture
    return np.rint(255 * to_srgb(to_linear(picture / 255.0) * factor)).astype(np.uint8)

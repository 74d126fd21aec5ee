"""Edits of a scene file that give parameters other values: colours, numbers, transformations, textures."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..errors import OutputError, mitsuba_message
from ..io.files import atomic
from ..io.images import to_linear, to_srgb, write_image
from .changes import Array
from .parsed_scene import ParsedScene
from .scene_edits import (
    FILES_FOLDER,
    TEXTURE_TOLERANCE,
    EditedScene,
    Step,
    Unwritable,
    is_close,
    matrix_of,
    text_of,
)
from .xml_text import Element, XmlText, tag

# Names of the elements that place a shape, by its plug-in.
_PLACES = {"sphere": ("center", "radius"), "cylinder": ("p0", "p1", "radius")}


@dataclass
class ValueStep(Step):
    """A parameter by its name. ``key``: the name that the scene knew before, of a colour that becomes a texture."""

    name: str
    key: str
    value: Array
    parsed: ParsedScene

    def __post_init__(self) -> None:
        self.owner = self.key
        self.is_texture = self.value.ndim == 3 and self.key.endswith((".value", ".data"))

    def apply(self, scene: EditedScene) -> None:
        place = self.parsed.place(self.key)
        if place is None:
            raise Unwritable("it belongs to nothing in the file")
        if not np.isfinite(self.value).all():
            raise Unwritable("its value is not finite")
        text, element, path = place.text, place.element, place.path
        if len(path) > 1 and path[0] == "bsdf" and element.tag == "shape":
            self._default_bsdf(scene, text, element, path[1:])
        elif path[-1] == "data":
            self._data(scene, text, element, path)
        elif path[1:] in (("value",), ("value", "value")):  # the latter of media, in volumes that are the same everywhere
            self._colour(scene, text, element, path[0])
        elif len(path) == 1:
            self._number(text, element, path[0])
        else:
            raise Unwritable(f"a {element.get('type')} says nothing of {'.'.join(path)} in scene files")

    def _default_bsdf(self, scene: EditedScene, text: XmlText, element: Element, path: tuple[str, ...]) -> None:
        """The material that Mitsuba gives shapes without one: diffuse."""
        if path != ("reflectance", "value"):
            raise Unwritable("the shape has no material in the file")
        text.append(element, tag("bsdf", {"type": "diffuse"}, self._colour_text(scene, path[0], "rgb")))

    def _colour(self, scene: EditedScene, text: XmlText, element: Element, name: str) -> None:
        child = element.named(name)
        if child is not None and child.tag == "ref":
            raise Unwritable("it is shared by others in the file")
        if name in ("eta", "k") and element.named("material") is not None:
            self._metal(scene, text, element)
            return
        old = child.tag if child is not None else ""
        if element.tag == "emitter" and old != "float":  # where Mitsuba takes a spectrum times that of daylight
            old = "rgb"
        new = self._colour_text(scene, child.get("name") if child is not None else name, old)
        if child is not None and not text.is_removed(child):
            text.replace(child, new)
        else:
            text.append(element, new)

    def _metal(self, scene: EditedScene, text: XmlText, element: Element) -> None:
        """Metals with a name: both numbers of its index of refraction are written instead."""
        material = element.named("material")
        assert material is not None
        if not text.is_removed(material):
            text.replace(material, None)
        base = self.key.removesuffix(".value").rpartition(".")[0]
        own = self.key.removesuffix(".value").rpartition(".")[2]
        text.append(element, self._colour_text(scene, own, "rgb"))
        other = "k" if own == "eta" else "eta"
        if f"{base}.{other}.value" not in scene.changed and not any(child.get("name") == other for child in element.children):
            value = np.array(self.parsed.parameters[f"{base}.{other}.value"]).ravel()
            text.append(element, tag("rgb", {"name": other, "value": text_of(value, ", ")}))

    def _colour_text(self, scene: EditedScene, name: str, old: str) -> str:
        if self.is_texture:
            path = self._picture(scene, raw=False)
            return tag(
                "texture",
                {"type": "bitmap", "name": name},
                tag("string", {"name": "filename", "value": f"{FILES_FOLDER}/{path.name}"}),
                tag("string", {"name": "format", "value": "variant"}),
            )
        numbers = self.value.ravel()
        if len(numbers) not in (1, 3):
            raise Unwritable(f"it has {len(numbers)} numbers")
        if len(numbers) == 3:
            kind = "rgb"
        else:
            kind = old if old in ("float", "spectrum", "rgb") else "spectrum"
        return tag(kind, {"name": name, "value": text_of(numbers, ", ")})

    def _data(self, scene: EditedScene, text: XmlText, element: Element, path: tuple[str, ...]) -> None:
        """Pixels of a picture."""
        if path != ("data",) or element.get("type") not in ("bitmap", "envmap"):
            raise Unwritable(f"only pictures of bitmaps and environment maps can be, not those of a {element.get('type')}")
        if self.value.ndim != 3:
            raise Unwritable(f"its shape {self.value.shape} is not (H, W, C)")
        raw = element.named("raw")
        is_raw = raw is not None and self.parsed.substituted(raw.get("value")).lower() == "true"
        file = self._picture(scene, is_raw, environment=element.get("type") == "envmap")
        name = element.named("filename")
        new = f"{FILES_FOLDER}/{file.name}"
        if name is None:
            text.append(element, tag("string", {"name": "filename", "value": new}))
        else:
            text.set(name, value=new)
        if element.get("type") == "bitmap":
            stored = element.named("format")
            if stored is None:
                text.append(element, tag("string", {"name": "format", "value": "variant"}))
            else:
                text.set(stored, value="variant")

    def _picture(self, scene: EditedScene, raw: bool, environment: bool = False) -> Path:
        """Write the pixels: PNG of 16 bits if they are all in 0..1, else OpenEXR."""
        pixels = _linear(self.value, raw)
        if environment:  # Mitsuba repeats columns at its ends
            pixels = pixels[:, 1:-1] if self.value.shape[1] > 2 else pixels
        stem = re.sub(r"\.(value|data)$", "", self.name)
        if environment or pixels.min() < 0 or pixels.max() > 1:
            path = scene.new_file(stem, ".exr")
            write_image(path, pixels)
            return path
        encoded = pixels if raw else np.concatenate([to_srgb(pixels[..., :3]), pixels[..., 3:]], -1)
        path = scene.new_file(stem, ".png")
        bitmap = mi.Bitmap(np.rint(encoded * 65535).astype(np.uint16))
        with atomic(path) as temporary:
            try:
                bitmap.write(str(temporary))
            except RuntimeError as error:
                raise OutputError(f"cannot write {path}: {mitsuba_message(error)}") from error
        return path

    def _number(self, text: XmlText, element: Element, name: str) -> None:
        """Parameters of the object itself: numbers, points, transformations."""
        special: dict[str, Callable[[XmlText, Element], None]] = {
            "to_world": self._to_world,
            "to_uv": lambda text, element: self._replace_transform(text, element, "to_uv"),
            "position": self._position,
            "x_fov": self._fov,
        }
        if element.named("eta") is None and not element.get("type").startswith("principled"):
            special["eta"] = self._eta
        if name in special:
            special[name](text, element)
            return
        numbers = self.value.ravel()
        child = element.named(name)
        if len(numbers) == 1:
            kind = child.tag if child is not None and child.tag == "spectrum" else "float"
        elif len(numbers) == 3:
            kind = child.tag if child is not None and child.tag in ("vector", "point", "rgb") else "vector"
        else:
            raise Unwritable(f"it has {len(numbers)} numbers")
        new = tag(kind, {"name": child.get("name") if child is not None else name, "value": text_of(numbers, ", ")})
        if child is None:
            text.append(element, new)
        else:
            text.replace(child, new)

    def _to_world(self, text: XmlText, element: Element) -> None:
        direction = element.named("direction")
        if direction is not None and element.get("type") == "directional":
            forward = matrix_of(self.value)[:3, 2]
            forward = forward / np.linalg.norm(forward)
            text.replace(direction, tag("vector", {"name": "direction", "value": text_of(forward, ", ")}))
            return
        for child in element.children:
            if element.tag == "shape" and child.get("name") in _PLACES.get(element.get("type"), ()):
                text.replace(child, None)
        self._replace_transform(text, element, "to_world")

    def _replace_transform(self, text: XmlText, element: Element, name: str) -> None:
        matrix = matrix_of(self.value)
        own = element.named(name)
        new = tag(
            "transform",
            {"name": own.get("name") if own is not None else name},
            tag("matrix", {"value": text_of(_of_planes(matrix))}),
        )
        if own is None:
            text.append(element, new)
        else:
            text.replace(own, new)

    def _position(self, text: XmlText, element: Element) -> None:
        place, own = element.named("position"), element.named("to_world")
        numbers = text_of(self.value.ravel(), ", ")
        if own is not None:
            text.replace(own, tag("transform", {"name": own.get("name")}, tag("translate", {"value": numbers})))
        elif place is not None:
            text.replace(place, tag("point", {"name": "position", "value": numbers}))
        else:
            text.append(element, tag("point", {"name": "position", "value": numbers}))

    def _fov(self, text: XmlText, element: Element) -> None:
        """The angle of view along the axis that the file measures it along."""
        axis_of, own, length = element.named("fov_axis"), element.named("fov"), element.named("focal_length")
        width, height = self._film_size()
        axis = "x" if length is not None or axis_of is None else self.parsed.substituted(axis_of.get("value"))
        if axis in ("smaller", "larger"):
            axis = "y" if (width > height) == (axis == "smaller") else "x"
        across = math.tan(math.radians(float(self.value.ravel()[0])) / 2)
        scale = {"x": 1.0, "y": height / width, "diagonal": math.hypot(1, height / width)}.get(axis)
        if scale is None:
            raise Unwritable(f"the axis {axis!r} of its angle is none of Mitsuba's")
        angle = math.degrees(2 * math.atan(scale * across))
        if length is not None:
            text.replace(length, None)
        new = tag("float", {"name": "fov", "value": f"{angle:.9g}"})
        if own is None:
            text.append(element, new)
        else:
            text.replace(own, new)

    def _film_size(self) -> tuple[int, int]:
        size = np.array(self.parsed.parameters[f"{self.key.rpartition('.')[0]}.film.size"]).ravel()
        return int(size[0]), int(size[1])

    def _eta(self, text: XmlText, element: Element) -> None:
        """The ratio of two indices of refraction: the inner one is written, the outer one is 1."""
        inner, outer = element.named("int_ior"), element.named("ext_ior")
        for child, name, value in ((inner, "int_ior", float(self.value.ravel()[0])), (outer, "ext_ior", 1.0)):
            new = tag("float", {"name": name, "value": f"{value:.9g}"})
            if child is None:
                text.append(element, new)
            else:
                text.replace(child, new)

    def difference(self, before: ParsedScene, after: ParsedScene) -> str:
        table = after.parameters
        if self.is_texture:
            key = re.sub(r"\.value$", ".data", self.key)
            expected, found = _linear(self.value, False), _linear(np.array(table[key]), False)
            if self.key.endswith(".data") and self._is_raw():
                expected, found = np.asarray(self.value, np.float64), np.array(table[key])
            if expected.shape != found.shape:
                return f"the picture has the shape {found.shape} there instead of {expected.shape}"
            if isinstance(self.parsed.parameters.properties[self.key][2], mi.Emitter) and expected.shape[1] > 2:
                # Mitsuba repeats columns of a sky at its ends.
                expected, found = expected[:, 1:-1], found[:, 1:-1]
            worst = float(np.abs(expected - found).max())
            return "" if worst <= TEXTURE_TOLERANCE * max(1.0, np.abs(expected).max()) else f"it differs by {worst:.2g} there"
        wanted = self.value
        value = table[self.key]
        if self.key.endswith(("to_world", "to_uv")):
            found, wanted = matrix_of(value), matrix_of(wanted)
            place = self.parsed.place(self.key)
            if place is not None and place.element.get("type") == "directional":
                wanted = wanted[:3, 2] / np.linalg.norm(wanted[:3, 2])
                found = found[:3, 2] / np.linalg.norm(found[:3, 2])
        else:
            found, wanted = np.array(value, np.float64).ravel(), np.asarray(wanted, np.float64).ravel()
        if self.key.endswith("direction"):  # Mitsuba keeps unit vectors
            found, wanted = (vector / np.linalg.norm(vector) for vector in (found, wanted))
        if found.size != wanted.size and 1 in (found.size, wanted.size):
            found, wanted = np.broadcast_arrays(found, wanted)
        return "" if is_close(found, wanted) else f"it is {text_of(found.ravel()[:4], ', ')} there"

    def _is_raw(self) -> bool:
        place = self.parsed.place(self.key)
        raw = place.element.named("raw") if place is not None else None
        return raw is not None and self.parsed.substituted(raw.get("value")).lower() == "true"


def _of_planes(matrix: Array) -> Array:
    """A transformation of the plane as one of space."""
    if matrix.shape == (4, 4):
        return matrix
    space = np.eye(4)
    space[np.ix_([0, 1, 3], [0, 1, 3])] = matrix
    return space


def _linear(pixels: Array, raw: bool) -> Array:
    """Linear pixels of a texture, whose integers are sRGB unless it is raw."""
    if pixels.dtype.kind not in "ui":
        return np.asarray(pixels, np.float64)
    scaled = pixels / float(np.iinfo(pixels.dtype).max)
    return scaled if raw else np.concatenate([to_linear(scaled[..., :3]), scaled[..., 3:]], -1)

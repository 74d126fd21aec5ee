"""Edits of a scene file's text, one for each change of a fit, and whether they are found in what Mitsuba reads again."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import mitsuba as mi
import numpy as np

from ..errors import OutputError, ShadowmapError, mitsuba_message
from ..io.files import atomic
from ..io.images import to_linear, to_srgb, write_image
from ..io.meshes import write_ply
from ..scene.mitsuba_meshes import VERTEX_PARAMETERS, mesh_buffers, positions_in, set_positions
from .changes import Array
from .parsed_scene import ParsedScene
from .xml_text import Element, XmlText, tag

#: Largest relative difference between a value and what Mitsuba reads from the written file; of textures, absolute.
TOLERANCE, TEXTURE_TOLERANCE = 1e-4, 1e-3
#: Folder of meshes and pictures beside the scene file.
FILES_FOLDER = "scene_files"


class Unwritable(Exception):
    """A reason why a change cannot be written: a clause for a note."""


class EditedScene(Protocol):
    """A scene whose text is edited. ``changed``: names of parameters that are."""

    parsed: ParsedScene
    changed: set[str]

    def new_file(self, stem: str, suffix: str) -> Path:
        """A file in the folder, with a name that is not taken."""


class Step:
    """One change: how it is written, and how it is found again. ``owner``: begin of the names of parameters that it changes."""

    owner: str

    def apply(self, scene: EditedScene) -> None:
        """Edit the texts. Raises Unwritable if the change cannot be expressed in a scene file."""
        raise NotImplementedError

    def difference(self, before: ParsedScene, after: ParsedScene) -> str:
        """The reason why the written scene does not have the change; empty if it has."""
        raise NotImplementedError


@dataclass
class TransformStep(Step):
    """A map of world space behind a shape's own."""

    name: str
    shape: mi.Shape
    matrix: Array

    def __post_init__(self) -> None:
        self.owner = self.shape.id()
        if self.matrix.shape != (4, 4):
            raise ShadowmapError(f"The map of {self.name!r} has the shape {self.matrix.shape}, but must be a matrix (4, 4).")

    def apply(self, scene: EditedScene) -> None:
        text, element = _element_of(scene.parsed, self.shape)
        moved = tag("matrix", {"value": _text(self.matrix)})
        own = element.named("to_world")
        if own is None:
            text.append(element, tag("transform", {"name": "to_world"}, moved))
        else:
            text.append(own, moved)

    def difference(self, before: ParsedScene, after: ParsedScene) -> str:
        old, new = before.shapes[self.name], after.shapes[self.name]
        if isinstance(old, mi.Mesh):
            expected, found = mapped(self.matrix, vertices_of(old)), vertices_of(new)
            return _difference_of_points(found, expected)
        tables = [mi.traverse(shape) for shape in (old, new)]
        if "to_world" in tables[0]:
            own, moved = (_matrix(table["to_world"]) for table in tables)
            if _is_stretched(old, self.matrix @ own):
                return f"Mitsuba draws a {old.class_name()} only round"
            return "" if is_close(moved, self.matrix @ own) else "its to_world is another one there"
        if "control_points" in tables[0]:
            points, found = (np.array(table["control_points"]).reshape(-1, 4)[:, :3] for table in tables)
            return _difference_of_points(found, mapped(self.matrix, points))
        return f"Mitsuba does not tell where a {old.class_name()} lies"


@dataclass
class MeshStep(Step):
    """A mesh with other vertices or attributes, as a PLY file."""

    name: str
    shape: mi.Mesh
    vertices: Array | None
    attributes: dict[str, Array]
    normals: Array | None = None

    def __post_init__(self) -> None:
        self.owner = self.shape.id()

    def apply(self, scene: EditedScene) -> None:
        text, element = _element_of(scene.parsed, self.shape)
        old = mesh_buffers(self.shape)
        vertices = vertices_of(self.shape) if self.vertices is None else self.vertices
        if len(vertices) != len(old.positions) // 3:
            raise Unwritable(f"{len(vertices)} vertices were given, but the mesh has {len(old.positions) // 3}")
        if not np.isfinite(vertices).all():
            raise Unwritable("some vertices are not finite")
        path = scene.new_file(self.name, ".ply")
        self._write(path, vertices)
        text.set(element, type="ply")
        for child in element.children:
            if child.tag in _VALUES and child.get("name") not in _OF_ALL_MESHES:
                text.replace(child, None)
        text.append(element, tag("string", {"name": "filename", "value": f"{FILES_FOLDER}/{path.name}"}))
        if self.normals is None and element.named("face_normals") is None:
            text.append(element, tag("boolean", {"name": "face_normals", "value": "true"}))

    def _write(self, path: Path, vertices: Array) -> None:
        """Write the mesh with these vertices. Normals follow from them, as after an update of Mitsuba's."""
        table = mi.traverse(self.shape)
        if not any(name in table for name in VERTEX_PARAMETERS):
            self._write_plain(path, vertices)
            return
        before = {name: type(table[name])(table[name]) for name in self.attributes}
        positions = mi.Float(positions_in(table))
        try:
            set_positions(table, mi.Float(vertices.ravel()))
            for name, values in self.attributes.items():
                if len(values) != np.size(table[name]):
                    raise Unwritable(f"{name} has {len(values)} numbers instead of {np.size(table[name])}")
                table[name] = type(table[name])(mi.Float(values))
            table.update()
            self.normals = np.array(mesh_buffers(self.shape).normals)
            write_ply(path, self.shape)
        finally:
            set_positions(table, positions)
            for name, old in before.items():
                table[name] = old
            table.update()

    def _write_plain(self, path: Path, vertices: Array) -> None:
        """Write a mesh whose vertices Mitsuba does not let be changed: a rectangle."""
        old = mesh_buffers(self.shape)
        mesh = mi.Mesh(self.name, len(vertices), len(old.faces) // 3, has_vertex_texcoords=bool(len(old.texcoords)))
        table = mi.traverse(mesh)
        set_positions(table, mi.Float(vertices.ravel()))
        table["faces"] = old.faces
        if len(old.texcoords):
            table["vertex_texcoords"] = old.texcoords
        table.update()
        write_ply(path, mesh)

    def difference(self, before: ParsedScene, after: ParsedScene) -> str:
        old, new = before.shapes[self.name], after.shapes[self.name]
        if not np.array_equal(np.array(mesh_buffers(old).faces), np.array(mesh_buffers(new).faces)):
            return "the triangles are others there"
        expected = vertices_of(old) if self.vertices is None else self.vertices
        reason = _difference_of_points(vertices_of(new), expected)
        table = mi.traverse(new)
        for name, values in self.attributes.items():
            if not is_close(np.array(table[name]), values):
                reason = reason or f"its {name} is another one there"
        if self.normals is not None and not is_close(np.array(mesh_buffers(new).normals), self.normals, 1e-2):
            reason = reason or "its normals are others there"
        texcoords, old_texcoords = (np.array(mesh_buffers(mesh).texcoords) for mesh in (new, old))
        return reason or ("" if is_close(texcoords, old_texcoords) else "its texture coordinates are others there")


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
            text.append(element, tag("rgb", {"name": other, "value": _text(value, ", ")}))

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
        return tag(kind, {"name": name, "value": _text(numbers, ", ")})

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
        new = tag(kind, {"name": child.get("name") if child is not None else name, "value": _text(numbers, ", ")})
        if child is None:
            text.append(element, new)
        else:
            text.replace(child, new)

    def _to_world(self, text: XmlText, element: Element) -> None:
        direction = element.named("direction")
        if direction is not None and element.get("type") == "directional":
            forward = _matrix(self.value)[:3, 2]
            forward = forward / np.linalg.norm(forward)
            text.replace(direction, tag("vector", {"name": "direction", "value": _text(forward, ", ")}))
            return
        for child in element.children:
            if element.tag == "shape" and child.get("name") in _PLACES.get(element.get("type"), ()):
                text.replace(child, None)
        self._replace_transform(text, element, "to_world")

    def _replace_transform(self, text: XmlText, element: Element, name: str) -> None:
        matrix = _matrix(self.value)
        own = element.named(name)
        new = tag(
            "transform",
            {"name": own.get("name") if own is not None else name},
            tag("matrix", {"value": _text(_of_planes(matrix))}),
        )
        if own is None:
            text.append(element, new)
        else:
            text.replace(own, new)

    def _position(self, text: XmlText, element: Element) -> None:
        place, own = element.named("position"), element.named("to_world")
        numbers = _text(self.value.ravel(), ", ")
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
            worst = float(np.abs(expected - found).max())
            return "" if worst <= TEXTURE_TOLERANCE * max(1.0, np.abs(expected).max()) else f"it differs by {worst:.2g} there"
        wanted = self.value
        value = table[self.key]
        if self.key.endswith(("to_world", "to_uv")):
            found, wanted = _matrix(value), _matrix(wanted)
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
        return "" if is_close(found, wanted) else f"it is {_text(found.ravel()[:4], ', ')} there"

    def _is_raw(self) -> bool:
        place = self.parsed.place(self.key)
        raw = place.element.named("raw") if place is not None else None
        return raw is not None and self.parsed.substituted(raw.get("value")).lower() == "true"


# -------------------------------------------------------------------------------------------------------------------- helpers

# Elements of values; names of those that meshes of all files have; names of those that place a shape, by its plug-in.
_OF_ALL_MESHES = ("face_normals", "flip_normals", "silhouette_sampling_weight")
_VALUES = ("boolean", "float", "integer", "matrix", "point", "string", "transform", "vector")
_PLACES = {"sphere": ("center", "radius"), "cylinder": ("p0", "p1", "radius")}


def _element_of(parsed: ParsedScene, shape: mi.Shape) -> tuple[XmlText, Element]:
    found = parsed.shape_element(shape)
    if found is None:
        raise Unwritable("it belongs to nothing in the file")
    return found


def _text(values: Any, between: str = " ") -> str:  # Any: numbers, nested or not
    """Numbers as text, in single precision."""
    return between.join(f"{float(value):.9g}" for value in np.ravel(values))


def _matrix(value: Any) -> Array:  # Any: a transformation of Mitsuba's, or an array
    matrix = np.array(value.matrix if is_transform(value) else value, np.float64)
    if matrix.ndim == 3:  # of arrays with one entry
        matrix = matrix.reshape(matrix.shape[:2])
    if matrix.shape not in ((4, 4), (3, 3)):
        raise Unwritable(f"its shape {matrix.shape} is not (4, 4)")
    return matrix


def _is_stretched(shape: mi.Shape, to_world: Array) -> bool:
    """True if a sphere or cylinder, which Mitsuba only warns of, is none any more."""
    round_axes = {"Sphere": 3, "Cylinder": 2}.get(shape.class_name(), 0)
    products = to_world[:3, :3].T @ to_world[:3, :3]
    expected = np.diag(np.diagonal(products))
    expected[range(round_axes), range(round_axes)] = products[0, 0]
    return bool(round_axes) and not is_close(products, expected, 1e-3)


def is_transform(value: Any) -> bool:  # Any: parameters have values of all kinds
    """True if a value is a transformation. Not by its ``matrix``: Dr.Jit's vectors have that, too, as letters of coordinates."""
    return "Transform" in type(value).__name__


def _of_planes(matrix: Array) -> Array:
    """A transformation of the plane as one of space."""
    if matrix.shape == (4, 4):
        return matrix
    space = np.eye(4)
    space[np.ix_([0, 1, 3], [0, 1, 3])] = matrix
    return space


def mapped(matrix: Array, points: Array) -> Array:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def vertices_of(mesh: mi.Mesh) -> Array:
    """Vertices (V, 3) in world space."""
    return np.array(mesh_buffers(mesh).positions, np.float64).reshape(-1, 3)


def _difference_of_points(found: Array, expected: Array) -> str:
    if found.shape != expected.shape:
        return f"it has {len(found)} vertices there instead of {len(expected)}"
    if not len(expected):
        return ""
    worst = float(np.abs(found - expected).max())
    return "" if worst <= TOLERANCE * max(float(np.abs(expected).max()), 1e-12) else f"its vertices differ by {worst:.2g} there"


def is_close(found: Array, expected: Array, tolerance: float = TOLERANCE) -> bool:
    if found.shape != expected.shape:
        return False
    if not expected.size:
        return True
    with np.errstate(over="ignore", invalid="ignore"):
        most = float(np.abs(np.nan_to_num(expected)).max())
        return bool(np.abs(np.nan_to_num(found) - np.nan_to_num(expected)).max() <= tolerance * max(most, 1e-12))


def numbers_of(value: Any) -> Array | None:  # Any: parameters have values of all kinds
    """A parameter's value in double precision; None if it is no number."""
    try:
        return _matrix(value) if is_transform(value) else np.array(value, np.float64)
    except (TypeError, ValueError, Unwritable):
        return None


def _linear(pixels: Array, raw: bool) -> Array:
    """Linear pixels of a texture, whose integers are sRGB unless it is raw."""
    if pixels.dtype.kind not in "ui":
        return np.asarray(pixels, np.float64)
    scaled = pixels / float(np.iinfo(pixels.dtype).max)
    return scaled if raw else np.concatenate([to_linear(scaled[..., :3]), scaled[..., 3:]], -1)

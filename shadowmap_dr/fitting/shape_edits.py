"""Edits of a scene file that move shapes as a whole, or replace the vertices of meshes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..errors import ShadowmapError
from ..io.meshes import write_ply
from ..jit.arrays import device_array
from ..scene.mitsuba_meshes import VERTEX_PARAMETERS, mesh_buffers, positions_in, set_positions
from .changes import Array
from .parsed_scene import ParsedScene
from .scene_edits import (
    FILES_FOLDER,
    TOLERANCE,
    EditedScene,
    Step,
    Unwritable,
    element_of,
    is_close,
    matrix_of,
    text_of,
)
from .xml_text import tag

# Elements of values, and names of those that meshes of all files have.
_OF_ALL_MESHES = ("face_normals", "flip_normals", "silhouette_sampling_weight")
_VALUES = ("boolean", "float", "integer", "matrix", "point", "string", "transform", "vector")


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
        text, element = element_of(scene.parsed, self.shape)
        moved = tag("matrix", {"value": text_of(self.matrix)})
        own = element.named("to_world")
        if own is None:
            text.append(element, tag("transform", {"name": "to_world"}, moved))
        else:
            text.append(own, moved)

    def difference(self, before: ParsedScene, after: ParsedScene) -> str:
        old, new = before.shapes[self.owner], after.shapes[self.owner]
        if isinstance(old, mi.Mesh):
            expected, found = mapped(self.matrix, vertices_of(old)), vertices_of(new)
            return _difference_of_points(found, expected)
        tables = [mi.traverse(shape) for shape in (old, new)]
        if "to_world" in tables[0]:
            own, moved = (matrix_of(table["to_world"]) for table in tables)
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
        text, element = element_of(scene.parsed, self.shape)
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
            set_positions(table, device_array(mi.Float, vertices))
            for name, values in self.attributes.items():
                if len(values) != np.size(table[name]):
                    raise Unwritable(f"{name} has {len(values)} numbers instead of {np.size(table[name])}")
                table[name] = type(table[name])(device_array(mi.Float, values))
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
        set_positions(table, device_array(mi.Float, vertices))
        table["faces"] = old.faces
        if len(old.texcoords):
            table["vertex_texcoords"] = old.texcoords
        table.update()
        write_ply(path, mesh)

    def difference(self, before: ParsedScene, after: ParsedScene) -> str:
        old, new = before.shapes[self.owner], after.shapes[self.owner]
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


def _is_stretched(shape: mi.Shape, to_world: Array) -> bool:
    """True if a sphere or cylinder, which Mitsuba only warns of, is none any more."""
    round_axes = {"Sphere": 3, "Cylinder": 2}.get(shape.class_name(), 0)
    products = to_world[:3, :3].T @ to_world[:3, :3]
    expected = np.diag(np.diagonal(products))
    expected[range(round_axes), range(round_axes)] = products[0, 0]
    return bool(round_axes) and not is_close(products, expected, 1e-3)


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

"""Changes made to the objects of a Mitsuba scene, for as long as it is rendered with them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import ShadowmapError
from ..jit.arrays import device_array
from ..scene.load import SceneData
from ..scene.mitsuba_meshes import VERTEX_PARAMETERS, mesh_buffers, mesh_names
from ..scene.shapes.sources import ShapeSource
from .changes import Array, Changes


@contextmanager
def updated(data: SceneData, changes: Changes) -> Iterator[mi.Scene]:
    """Context in which a scene has the values, places and vertices of some changes. It gets its old ones back at the end.

    Values of sensors are left out: :mod:`~shadowmap_dr.fitting.reference` makes its own.

    Raises:
        ShadowmapError: Mitsuba's objects do not have such a value, or do not let it be changed.
    """
    table = mi.traverse(data.scene)
    update = _Update(table)
    sensors = tuple(f"{cameras[0].name}." for cameras in data.sensors)
    sources = dict(zip((info.name for info in data.geometry.shapes), data.sources, strict=True))
    try:
        for key, value in changes.values.items():
            if not key.startswith(sensors):
                update.set_value(key, value)
        for name, vertices in changes.vertices.items():
            update.set_vertices(sources[name].shape, vertices)
        for name, matrix in changes.transforms.items():
            _check_instance(name, changes.transforms, sources)
            update.move(sources[name], matrix)
        update.apply()
        yield data.scene
    finally:
        update.undo()


def _check_instance(name: str, transforms: Mapping[str, Array], sources: Mapping[str, ShapeSource]) -> None:
    """ShadowmapError for a part of an instance that does not move with all others: Mitsuba has one place for them."""
    instance, matrix = sources[name].instance, transforms[name]
    parts = [other for other, source in sources.items() if instance is not None and source.instance == instance]
    if not all(other in transforms and np.array_equal(transforms[other], matrix) for other in parts):
        raise ShadowmapError(f"{name!r} moves, but not all parts of its instance.")


class _Update:
    """New values of a table of ``mi.traverse``, with the old ones."""

    def __init__(self, table: mi.SceneParameters) -> None:
        self._table = table
        # Any: parameters have values of all kinds.
        self._old: dict[str, Any] = {}
        self._new: dict[str, Any] = {}
        # Mitsuba makes normals of its own when vertices change: a mesh gets its normals in a second step.
        self._old_normals: dict[str, Any] = {}
        self._new_normals: dict[str, Any] = {}

    def set_value(self, key: str, value: Array) -> None:
        if key not in self._table:
            raise ShadowmapError(f"{key} is no parameter of Mitsuba's objects.")
        old = self._table[key]
        if dr.is_matrix_v(old) or "Transform" in type(old).__name__:
            new = type(old)(np.asarray(value, np.float64))
        elif dr.is_tensor_v(old):
            new = type(old)(np.asarray(value, np.float32).reshape(old.shape))
        else:
            new = _like(old, np.asarray(value, np.float32))
        self._keep(key, new)

    def set_vertices(self, mesh: mi.Mesh, vertices: Array) -> None:
        """New vertices, with the normals that Mitsuba makes of them."""
        names = mesh_names(mesh)
        key = self._key(mesh, names.positions)
        self._keep(key, _flat(self._table[key], vertices))
        if len(mesh_buffers(mesh).normals):
            key = self._key(mesh, names.normals)
            self._old_normals[key] = _copy(self._table[key])

    def move(self, source: ShapeSource, matrix: Array) -> None:
        shape = source.shape if source.instance is None else source.instance
        if isinstance(shape, mi.Mesh) and any(name in mi.traverse(shape) for name in VERTEX_PARAMETERS):
            self._move_mesh(shape, matrix)
            return
        key = self._key(shape, "to_world")
        old = self._table[key]
        self._keep(key, type(old)(np.asarray(matrix @ np.array(dr.detach(old.matrix)).reshape(4, 4), np.float64)))

    def _move_mesh(self, mesh: mi.Mesh, matrix: Array) -> None:
        names, buffers = mesh_names(mesh), mesh_buffers(mesh)
        points, normals = (np.array(dr.detach(one), np.float64).reshape(-1, 3) for one in (buffers.positions, buffers.normals))
        linear = matrix[:3, :3]
        key = self._key(mesh, names.positions)
        self._keep(key, _flat(self._table[key], points @ linear.T + matrix[:3, 3]))
        if len(normals):
            turned = normals @ np.linalg.inv(linear)
            turned /= np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-30)
            key = self._key(mesh, names.normals)
            self._old_normals[key] = _copy(self._table[key])
            self._new_normals[key] = _flat(self._table[key], turned)

    def _key(self, shape: mi.Shape, name: str) -> str:
        """Name in the table of a parameter of a shape."""
        for key, (_, _, owner, *_) in self._table.properties.items():
            if owner == shape and key.endswith(name):
                return key
        raise ShadowmapError(f"Mitsuba does not let the {name} of {shape.id()!r} be changed.")

    def _keep(self, key: str, new: Any) -> None:  # Any: see above
        self._old.setdefault(key, _copy(self._table[key]))
        self._new[key] = new

    def apply(self) -> None:
        for values in (self._new, self._new_normals):
            self._write(values)

    def undo(self) -> None:
        for values in (self._old, self._old_normals):
            self._write(values)

    def _write(self, values: dict[str, Any]) -> None:  # Any: see above
        if values:
            for key, value in values.items():
                self._table[key] = value
            self._table.update()


def _copy(value: Any) -> Any:  # Any: a parameter's value
    return type(value)(dr.detach(value))


def _like(old: Any, value: Array) -> Any:  # Any: an array type of Mitsuba's
    """Numbers as a value of the type of another one: a number, a colour, or an array."""
    if dr.depth_v(old) > 1:
        numbers = np.broadcast_to(value.ravel(), (len(old),)).tolist()
        return type(old)(*numbers)
    return type(old)(np.broadcast_to(value.ravel(), (max(dr.width(old), value.size),)).tolist())


def _flat(old: Any, rows: Array) -> Any:  # Any: a Float or a TensorXf
    values = device_array(mi.Float, rows)
    return mi.TensorXf(values, rows.shape) if dr.is_tensor_v(old) else values

"""The buffers of Mitsuba's meshes. The only module that knows the names that its versions give them.

Mitsuba 3.9 has flat arrays ``vertex_positions``, ``vertex_normals`` and ``vertex_texcoords``. Its development branch has tensors
``positions``, ``normals`` and ``texcoords`` with a row for each vertex, or for each entry that ``position_index`` or
``normal_index`` names for a vertex, and reverses faces itself where a mesh has ``flip_normals``
(https://github.com/mitsuba-renderer/mitsuba3/pull/1933).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy.typing as npt

from ..jit.arrays import device_array
from ..jit.types import Float, UInt32


class MeshNames(NamedTuple):
    """Names of a mesh's parameters."""

    positions: str
    normals: str
    texcoords: str


_FLAT = MeshNames("vertex_positions", "vertex_normals", "vertex_texcoords")
_TENSORS = MeshNames("positions", "normals", "texcoords")
#: Names of the parameters of meshes that move vertices, in all versions.
VERTEX_PARAMETERS = frozenset((*_FLAT, *_TENSORS))


class MeshBuffers(NamedTuple):
    """Flat buffers of a mesh of V vertices and F faces, world space; attached where the mesh's own are.

    ``faces`` UInt32 (3F,), ``positions`` Float (3V,), ``normals`` Float (3V,) or (0,), ``texcoords`` Float (2V,) or (0,).
    """

    faces: UInt32
    positions: Float
    normals: Float
    texcoords: Float


def mesh_names(mesh: mi.Mesh) -> MeshNames:
    """Names of the parameters of a mesh in the version of Mitsuba in use."""
    return _FLAT if _is_flat(mesh) else _TENSORS


def mesh_buffers(mesh: mi.Mesh) -> MeshBuffers:
    """Read the buffers of a mesh as they are now."""
    if _is_flat(mesh):
        vertices = (mesh.vertex_positions_buffer(), mesh.vertex_normals_buffer(), mesh.vertex_texcoords_buffer())
        return MeshBuffers(mi.UInt32(mesh.faces_buffer()), *(mi.Float(buffer) for buffer in vertices))
    position_index, normal_index = (_flat_index(mesh, name) for name in ("position_index", "normal_index"))
    return MeshBuffers(
        mi.UInt32(mesh.faces().array),
        _rows(mesh.positions().array, position_index),
        _rows(mesh.normals().array, normal_index),
        mi.Float(mesh.texcoords().array),
    )


def has_reversed_faces(shape: mi.Shape) -> bool:
    """True if the normals of a shape's faces are against their winding, by ``flip_normals``."""
    if isinstance(shape, mi.Mesh) and not _is_flat(shape):
        return False
    return bool(shape.has_flipped_normals())


def positions_in(table: mi.SceneParameters, shape: str = "") -> Float:
    """Vertices of a mesh, flat (3V,), attached, from ``mi.traverse`` of it or, with the ``shape``'s name, of a scene."""
    value = table[_position_key(table, shape)]
    return mi.Float(value.array if dr.is_tensor_v(value) else value)


def set_positions(table: mi.SceneParameters, positions: Float, shape: str = "") -> None:
    """Replace the vertices (3V,) that :func:`positions_in` reads, before ``table.update()``. Gradients flow to ``positions``."""
    key = _position_key(table, shape)
    table[key] = mi.TensorXf(positions, (dr.width(positions) // 3, 3)) if dr.is_tensor_v(table[key]) else positions


def _position_key(table: mi.SceneParameters, shape: str) -> str:
    keys = [f"{shape}.{names.positions}".lstrip(".") for names in (_FLAT, _TENSORS)]
    return next(key for key in keys if key in table)


def make_mesh(
    name: str,
    positions: npt.ArrayLike,
    faces: npt.ArrayLike,
    bsdf: mi.BSDF | None = None,
) -> mi.Mesh:
    """Make a ``mi.Mesh`` of vertices (V, 3) and faces (F, 3).

    Args:
        name: its id.
        positions: world space.
        faces: indices of vertices.
        bsdf: its material; None for Mitsuba's default.
    """
    points, corners = device_array(mi.Float, positions), device_array(mi.UInt32, faces)
    props = mi.Properties()
    if bsdf is not None:
        props["bsdf"] = bsdf
    if not _is_flat(mi.Mesh):
        tensors = mi.TensorXf(points, (len(points) // 3, 3)), mi.TensorXu(corners, (len(corners) // 3, 3))
        return mi.Mesh(name, positions=tensors[0], faces=tensors[1], props=props)
    mesh = mi.Mesh(name, len(points) // 3, len(corners) // 3, props=props)
    table = mi.traverse(mesh)
    table[_FLAT.positions], table["faces"] = points, corners
    table.update()
    return mesh


def _is_flat(mesh: Any) -> bool:  # Any: a mesh or its class
    return hasattr(mesh, "faces_buffer")


def _flat_index(mesh: mi.Mesh, name: str) -> UInt32 | None:
    """Row for each vertex, or None if vertices and rows are the same."""
    index = getattr(mesh, name, None)
    flat = None if index is None else mi.UInt32(dr.ravel(index()))
    return flat if flat is not None and dr.width(flat) else None


def _rows(values: Float, index: UInt32 | None) -> Float:
    """Values in threes, of the vertices, in order. Attached."""
    if index is None or not dr.width(values):
        return mi.Float(values)
    return mi.Float(dr.ravel(dr.gather(mi.Vector3f, values, index)))

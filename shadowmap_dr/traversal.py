"""Reading one Mitsuba object: parameters, children, mesh buffers. Nothing here walks the whole scene."""

from __future__ import annotations

from collections.abc import Hashable, Iterator
from contextlib import suppress
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np


def parameters(node: Any) -> dict[str, Any]:
    """Current (possibly AD-attached) parameters of a Mitsuba object and its children, by their relative names.

    Those without a value are left out: a ``hair`` material has some, and Mitsuba 3.9 raises a TypeError when one asks for them.
    """
    table = mi.traverse(node)
    found = {}
    for key in table.keys():
        with suppress(TypeError):
            found[key] = table[key]
    return found


def children(node: Any) -> list[tuple[str, Any]]:
    """(name, object) of the direct children of a Mitsuba object, in its own order."""
    found: list[tuple[str, Any]] = []

    # Defined here and not at module level: the base class belongs to the variant that is current.
    class Callback(mi.TraversalCallback):
        def put(self, name: str, value: Any, flags: int = 0, cpptype: Any = None) -> None:
            if isinstance(value, mi.Object):
                found.append((name, value))

    node.traverse(Callback())
    return found


def varies(texture: Any) -> bool:
    """Whether a ``mi.Texture`` may differ from place to place, attributes of meshes aside. Those written in Python may say what
    they like: the base class says no for them."""
    return texture.is_spatially_varying() or type(texture) is not mi.Texture


def fingerprint(value: Any) -> Hashable:
    """Something that changes when a parameter is given another value. That of an array is about which array it is."""
    if dr.is_array_v(value):
        return tuple(_indices(dr.detach(value)))
    matrix = getattr(value, "matrix", None)
    if matrix is None:
        return repr(value)
    return fingerprint(matrix) if dr.is_jit_v(matrix) else np.array(matrix).tobytes()


def _indices(array: Any) -> Iterator[int]:
    if dr.is_tensor_v(array):
        yield array.array.index
    elif dr.depth_v(array) == 1:
        yield array.index
    else:
        for part in array:
            yield from _indices(part)


def mesh_buffers(mesh: Any) -> tuple[Any, Any, Any, Any]:
    """(faces UInt32 (3F,), positions Float (3V,), normals Float (3V,) or (0,), texcoords Float (2V,) or (0,)) of a ``mi.Mesh``.

    World space; attached where the mesh's buffers are.
    """
    return (
        mi.UInt32(mesh.faces_buffer()),
        mi.Float(mesh.vertex_positions_buffer()),
        mi.Float(mesh.vertex_normals_buffer()),
        mi.Float(mesh.vertex_texcoords_buffer()),
    )

"""Reading one Mitsuba object: parameters, children, mesh buffers. Nothing here walks the whole scene."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import mitsuba as mi


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

"""Reading one Mitsuba object: parameters, children, mesh buffers. Nothing here walks the whole scene."""

from __future__ import annotations

import functools
from collections.abc import Container
from typing import Any

import drjit as dr
import mitsuba as mi

from ..jit.types import Float
from .mitsuba_meshes import VERTEX_PARAMETERS

_NO_ATTRIBUTES = VERTEX_PARAMETERS | {"vertex_count", "face_count"}
# Classes of BSDFs and emitters whose values depend on the place through their textures only.
_EVEN = frozenset(
    "SmoothDiffuse SmoothPlastic RoughPlastic SmoothConductor RoughConductor SmoothDielectric RoughDielectric Principled "
    "PrincipledThin ThinDielectric Null MaskBSDF BlendBSDF TwoSidedBRDF AreaLight".split()
)


def parameters(node: mi.Object) -> dict[str, Any]:
    """Current (possibly AD-attached) parameters of a Mitsuba object and its children, by their relative names.

    Parameters without a value are left out: a ``hair`` material has some.
    """
    found = {name: value if kind is None else mi.get_property(value, kind, owner) for name, value, kind, owner, _ in _walk(node)}
    return {name: value for name, value in found.items() if value is not None}


def owners(node: mi.Object) -> list[tuple[str, mi.Object]]:
    """(relative name, owning object) of all parameters of a Mitsuba object and its children."""
    return [(name, owner) for name, *_, owner, _ in _walk(node)]


def parameters_named(node: mi.Object, names: Container[str]) -> dict[str, Parameter]:
    """Parameters of a Mitsuba object and its children, by their relative names, to be read repeatedly."""
    return {name: Parameter(owner, own) for name, *_, owner, own in _walk(node) if name in names}


def _walk(root: mi.Object) -> list[tuple[str, Any, type | None, mi.Object, str]]:
    """(name, handle of the value, type, owner, name within the owner) of all parameters, with the names and in the order of
    ``mi.traverse``.

    That takes three times as long: it makes a class at each call, and records that serve to change parameters.
    """
    found: list[tuple[str, Any, type | None, mi.Object, str]] = []
    # One callback for all nodes: to make one takes as long as to list a node's parameters.
    _visit(root, "", found, {root}, set(), _collector(mi.variant())())
    return found


def _visit(
    node: mi.Object,
    prefix: str,
    found: list[tuple[str, Any, type | None, mi.Object, str]],
    seen: set[mi.Object],
    prefixes: set[str],
    callback: Any,  # Any: a class of a variant
) -> None:
    """Add the parameters of a node and its children to ``found``.

    Not a function within :func:`_walk`: a function that calls itself there refers to itself, and would keep these objects until
    garbage is collected. An area light that outlives its shape ends the process when Mitsuba calls all emitters.
    """
    for name, value, kind in _parts_of(node, callback):
        if not isinstance(value, mi.Object):
            found.append((prefix + name, value, kind, node, name))
        elif value not in seen:
            full, number = prefix + name, 1
            while full in prefixes:
                full, number = f"{prefix}{name}_{number}", number + 1
            prefixes.add(full)
            seen.add(value)
            _visit(value, full + ".", found, seen, prefixes, callback)


def children(node: mi.Object) -> list[tuple[str, mi.Object]]:
    """(name, object) of the direct children of a Mitsuba object, in its own order."""
    return [(name, value) for name, value, _ in _parts_of(node) if isinstance(value, mi.Object)]


def held_arrays(node: mi.Object) -> frozenset[int]:
    """Numbers of the Dr.Jit variables that a Mitsuba object and the objects it refers to hold."""
    found: list[int] = []
    with dr.scoped_set_flag(dr.JitFlag.EnableObjectTraversal, True):
        node._traverse_1_cb_ro(lambda index, variant, domain: found.append(index))
    return frozenset(found) - {0}


class Parameter:
    """One parameter of a Mitsuba object itself, not of its children, to be read repeatedly. The object is kept alive.

    Raises:
        KeyError: the object has no parameter of that name.
    """

    def __init__(self, node: mi.Object, name: str) -> None:
        self.node, self._name = node, name
        self._place, self._kind = self._found()

    def now(self) -> Any:  # Any: parameters have values of all kinds
        """The current, possibly attached, value."""
        return self._found()[0] if self._kind is None else mi.get_property(self._place, self._kind, self.node)

    def _found(self) -> tuple[Any, type | None]:
        for name, value, kind in _parts_of(self.node):
            if name == self._name and not isinstance(value, mi.Object):
                return value, kind
        raise KeyError(self._name)


def _parts_of(node: mi.Object, callback: Any = None) -> list[tuple[str, Any, type | None]]:  # Any: a class of a variant
    """(name, child or handle of a parameter's value, type of the parameter) of a Mitsuba object's children and parameters.

    ``callback``: an object of :func:`_collector` that serves again.
    """
    callback = callback or _collector(mi.variant())()
    found: list[tuple[str, Any, type | None]] = []
    callback.found = found
    node.traverse(callback)
    return found


@functools.cache
def _collector(variant: str) -> type:
    """A callback class for one variant, from which Mitsuba's base class comes."""

    class Collector(mi.TraversalCallback):
        def __init__(self) -> None:
            super().__init__()
            self.found: list[tuple[str, Any, type | None]] = []

        def put(self, name: str, value: object, flags: int = 0, cpptype: type | None = None) -> None:
            self.found.append((name, value, cpptype))

    return Collector


def varies(texture: mi.Texture) -> bool:
    """True if a ``mi.Texture`` may vary over a surface, attributes of meshes aside.

    Textures written in Python always may: Mitsuba's base class says no for them unless they override it.
    """
    return texture.is_spatially_varying() or type(texture) is not mi.Texture


def is_plain(bsdf: mi.BSDF) -> bool:
    """True if a BSDF's values are known to depend on nothing but cosines: diffuse, of the same colour everywhere, or zero."""
    parts = [part for _, part in children(bsdf)]
    if bsdf.class_name() == "TwoSidedBRDF":
        return all(is_plain(part) for part in parts)
    if bsdf.class_name() == "MaskBSDF":
        return all(is_plain(part) if isinstance(part, mi.BSDF) else _is_uniform(part) for part in parts)
    # Such surfaces send no light on that falls onto them from elsewhere.
    if bsdf.class_name() in ("Null", "ThinDielectric"):
        return True
    return bsdf.class_name() == "SmoothDiffuse" and all(_is_uniform(part) for part in parts)


def is_even(node: mi.BSDF | mi.Emitter) -> bool:
    """True if a BSDF or emitter is known to be the same everywhere: one of a known class, whose textures are."""
    if node.class_name() not in _EVEN:
        return False
    return all(is_even(part) if isinstance(part, mi.BSDF) else _is_uniform(part) for _, part in children(node))


def _is_uniform(texture: mi.Object) -> bool:
    """True for a texture that is the same everywhere."""
    # Mitsuba does not count vertex colours as varying.
    return isinstance(texture, mi.Texture) and not varies(texture) and texture.class_name() != "MeshAttribute"


def is_cosine(bsdf: mi.BSDF) -> bool:
    """True if a BSDF is known to be the light direction's cosine times a factor independent of directions: diffuse, or zero."""
    kind = bsdf.class_name()
    if kind == "SmoothDiffuse":
        textures = [part for _, part in children(bsdf)]
        # Textures written in Python may depend on directions.
        return all(type(part) is mi.Texture for part in textures)
    if kind in ("Null", "ThinDielectric"):
        return True
    if kind not in ("TwoSidedBRDF", "MaskBSDF"):
        return False
    return all(is_cosine(part) if isinstance(part, mi.BSDF) else type(part) is mi.Texture for _, part in children(bsdf))


def transmits(node: mi.Object) -> bool:
    """True for a BSDF that spreads light to its other side."""
    flags = node.flags() if isinstance(node, mi.BSDF) else 0
    return mi.has_flag(flags, mi.BSDFFlags.DiffuseTransmission) or mi.has_flag(flags, mi.BSDFFlags.GlossyTransmission)


def passes_evenly(bsdf: mi.BSDF) -> bool:
    """True if the share of light that passes a BSDF straight on is known not to vary over a surface."""
    for _, part in children(bsdf):
        if isinstance(part, mi.BSDF):
            if not passes_evenly(part):
                return False
        elif bsdf.class_name() in ("MaskBSDF", "BlendBSDF", "ThinDielectric") and not _is_uniform(part):
            return False
    return True


def is_attribute(node: mi.Object, key: str) -> bool:
    """True if a parameter is an attribute of a mesh: colours of vertices or faces, for instance."""
    return isinstance(node, mi.Mesh) and key.startswith(("vertex_", "face_")) and key not in _NO_ATTRIBUTES


def attributes(mesh: mi.Mesh) -> dict[str, Float]:
    """Attributes of a ``mi.Mesh`` by name: flat Float, of all vertices (``vertex_...``) or of all faces (``face_...``)."""
    return {name: value for name, value in parameters(mesh).items() if is_attribute(mesh, name)}

"""What a recording does not see of a scene: values that Mitsuba holds outside of the arrays that Dr.Jit compares."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from typing import Any

import drjit as dr
import mitsuba as mi

from .traversal import fingerprint, is_attribute


class Unseen:
    """Values that are parts of recordings like constants, so that these hold for no others.

    They are shapes of tensors (an ``envmap`` knows its own), Python's numbers and Mitsuba's scalar transformations (``to_uv`` of
    a bitmap, ``eta`` of a plastic, ``scale`` of a bump map), and arrays that Mitsuba 3.9 does not show to Dr.Jit: textures inside
    of bump maps, attributes of meshes, and what a ``sunsky`` makes tables from.

    Args:
        nodes: Mitsuba's BSDFs, emitters, and shapes whose attributes are read. They are kept alive.
    """

    def __init__(self, nodes: Iterable[Any]) -> None:
        self._held, self._sized = [], []
        for node in {id(node): node for node in nodes}.values():
            table = mi.traverse(node)
            for key in table.keys():
                with suppress(TypeError):  # raised for parameters without a value
                    value = table[key]
                    if not _is_seen(node, key, value):
                        self._held.append((table, key))
                    if dr.is_tensor_v(value):
                        self._sized.append((table, key))

    def now(self) -> tuple[Any, ...]:
        """The values as they are: those of two calls are equal if nothing has changed in between."""
        shapes = (tuple(table[key].shape) for table, key in self._sized)
        return (*(fingerprint(table[key]) for table, key in self._held), *shapes)


def _is_seen(node: Any, key: str, value: Any) -> bool:
    if key.endswith("sampling_weight"):
        return True  # means nothing here
    if node.class_name().startswith("Sunsky") and key in ("turbidity", "albedo.value"):
        return False
    if "nested_texture." in key or is_attribute(node, key):
        return False
    return dr.is_array_v(value) or isinstance(value, mi.Transform4f)

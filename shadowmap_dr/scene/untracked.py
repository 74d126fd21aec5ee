"""Untracked state of a scene, which a recording does not see: values that Mitsuba holds outside of the arrays that Dr.Jit
compares.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from itertools import count
from typing import Any

import drjit as dr
import mitsuba as mi

from .changes import fingerprint
from .mitsuba_objects import children, is_attribute

# Of so many objects, what there is to read is found out at once. Mitsuba's textures make arrays when they are asked what they
# have, and recordings of other scenes, too, are made anew when a scene comes to hold others.
_FEW = 32


class UntrackedValues:
    """Values that are parts of recordings like constants, so that these hold for no others.

    They are shapes of tensors (an ``envmap`` knows its own), Python's numbers and Mitsuba's scalar transformations (``to_uv`` of
    a bitmap, ``eta`` of a plastic, ``scale`` of a bump map), and arrays that Mitsuba 3.9 does not show to Dr.Jit: textures inside
    of bump maps, attributes of meshes, and what a ``sunsky`` makes tables from. And that lobes of ``principled`` materials have
    been switched on: Mitsuba leaves out those that are 0 when they are loaded until they are given another value.

    Args:
        nodes: Mitsuba's BSDFs, emitters, and shapes whose attributes are read. They are kept alive.
    """

    def __init__(self, nodes: Iterable[Any]) -> None:
        self._nodes = list(dict.fromkeys(nodes))
        self._known = False
        self._held, self._sized, self._off = [], [], []
        self._names: list[tuple[Any, str]] = []
        if len(self._nodes) <= _FEW:
            self._look()

    def _look(self) -> None:
        """Find out what there is to read. Most scenes are never recorded, and do without."""
        self._known = True
        for node in self._nodes:
            table, switched = mi.traverse(node), _has_switches(node)
            for key in table.keys():
                with suppress(TypeError):  # raised for parameters without a value
                    value = table[key]
                    if not _is_tracked(node, key, value):
                        self._held.append((table, key))
                        self._names.append((node, key))
                    if dr.is_tensor_v(value):
                        self._sized.append((table, key))
                    if switched and isinstance(value, mi.Float):
                        self._off.append(_Off(table, key))

    def names(self) -> list[tuple[Any, str]]:
        """The parameters among the values, each an object and its name there."""
        if not self._known:
            self._look()
        return self._names

    def now(self) -> tuple[Any, ...]:
        """The values as they are: those of two calls are equal if nothing has changed in between."""
        if not self._known:
            self._look()
        shapes = (tuple(table[key].shape) for table, key in self._sized)
        return (*(fingerprint(table[key]) for table, key in self._held), *shapes, *(value.still() for value in self._off))


class UntrackedState:
    """Describes the unseen values of objects for recordings of functions: see :func:`shadowmap_dr.jit.frozen.take_apart`.

    Args:
        nodes: as for :class:`UntrackedValues`.
    """

    def __init__(self, nodes: Iterable[Any]) -> None:
        self._nodes = tuple(nodes)
        self._values = UntrackedValues(self._nodes) if len(self._nodes) <= _FEW else None
        self._states: list[tuple[tuple[Any, ...], int]] = []

    def recording_text(self) -> str:
        """A number for the values as they are, that no other object has."""
        if self._values is None:
            self._values = UntrackedValues(self._nodes)
        now = self._values.now()
        if dr.flag(dr.JitFlag.FreezingScope) and self._states:
            # What the recorded function has set itself, it sets again.
            self._states[0] = (now, self._states[0][1])
        else:
            found = next((state for state in self._states if state[0] == now), None) or (now, next(_NUMBERS))
            self._states = [found, *(state for state in self._states if state is not found)][:_REMEMBERED]
        return f"unseen {self._states[0][1]}"


# Of states of objects, and how many of them one object remembers.
_NUMBERS, _REMEMBERED = count(1), 64


class _Off:
    """Watch over a parameter that may have been 0 all the time. Its value is read when there is a new one."""

    def __init__(self, table: Any, key: str) -> None:
        self._table, self._key, self._known, self._still = table, key, None, True

    def still(self) -> bool:
        if self._still:
            value = self._table[self._key]
            now = fingerprint(value)
            if now != self._known and not dr.flag(dr.JitFlag.FreezingScope):  # where nothing can be read
                self._known, self._still = now, bool(dr.all(dr.detach(value) == 0))
        return self._still


def _has_switches(node: Any) -> bool:
    """True if a BSDF is, or holds, one with lobes that Mitsuba switches on when their parameters are changed."""
    if not isinstance(node, mi.BSDF):
        return False
    return node.class_name().startswith("Principled") or any(_has_switches(child) for _, child in children(node))


def _is_tracked(node: Any, key: str, value: Any) -> bool:
    if key.endswith("sampling_weight"):
        return True  # means nothing here
    if node.class_name().startswith("Sunsky") and key in ("turbidity", "albedo.value"):
        return False
    if "nested_texture." in key or is_attribute(node, key):
        return False
    return dr.is_array_v(value) or isinstance(value, mi.Transform4f)

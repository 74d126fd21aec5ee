"""Untracked state of a scene: values that Mitsuba holds outside of the arrays that Dr.Jit compares, unseen by recordings."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from itertools import count

import drjit as dr
import mitsuba as mi

from .changes import fingerprint
from .mitsuba_objects import children, is_attribute

# Up to this many objects are traversed at once, others when their values are first needed. Traversing makes Mitsuba's textures
# allocate arrays, and recordings, of other scenes too, are made anew when the arrays of a scene change.
_FEW = 32


class UntrackedValues:
    """Values that a recording takes for constants: it holds for no others.

    They are shapes of tensors (an ``envmap`` stores its own), Python's numbers and Mitsuba's scalar transformations (``to_uv`` of
    a bitmap, ``eta`` of a plastic, ``scale`` of a bump map), and arrays that Mitsuba 3.9 does not show to Dr.Jit: textures inside
    bump maps, attributes of meshes, and the parameters of a ``sunsky``'s tables. Lobes of ``principled`` materials count too:
    Mitsuba leaves out a lobe whose parameter is 0 at loading until the parameter is given a value, be it 0 again.

    Args:
        nodes: Mitsuba's BSDFs, emitters, and shapes whose attributes are read. They are kept alive.
    """

    def __init__(self, nodes: Iterable[mi.Object]) -> None:
        self._nodes = list(dict.fromkeys(nodes))
        self._known = False
        self._held: list[tuple[mi.SceneParameters, str]] = []
        self._sized: list[tuple[mi.SceneParameters, str]] = []
        self._off: list[_Off] = []
        self._switched: list[mi.BSDF] = []
        self._names: list[tuple[mi.Object, str]] = []
        if len(self._nodes) <= _FEW:
            self._look()

    def _look(self) -> None:
        """Find the values to read. Most scenes are never recorded and do without."""
        self._known = True
        for node in self._nodes:
            table, switched = mi.traverse(node), _switched(node)
            self._switched += switched
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

    def names(self) -> list[tuple[mi.Object, str]]:
        """(object, name of one of its parameters) of the parameters among the values."""
        if not self._known:
            self._look()
        return self._names

    def now(self) -> tuple[object, ...]:
        """Keys of the current values: the keys of two calls are equal if nothing has changed in between."""
        if not self._known:
            self._look()
        shapes = (tuple(table[key].shape) for table, key in self._sized)
        lobes = (node.flags() for node in self._switched)
        return (*(fingerprint(table[key]) for table, key in self._held), *shapes, *(value.still() for value in self._off), *lobes)


class UntrackedState:
    """Description of the untracked values of objects for recordings: see :func:`shadowmap_dr.jit.frozen.take_apart`.

    Args:
        nodes: as for :class:`UntrackedValues`.
    """

    def __init__(self, nodes: Iterable[mi.Object]) -> None:
        self._nodes = tuple(nodes)
        self._values = UntrackedValues(self._nodes) if len(self._nodes) <= _FEW else None
        self._states: list[tuple[tuple[object, ...], int]] = []

    def recording_text(self) -> str:
        """A number for the current values, different from those of all other objects and values."""
        if self._values is None:
            self._values = UntrackedValues(self._nodes)
        now = self._values.now()
        if dr.flag(dr.JitFlag.FreezingScope) and self._states:
            # Values that the recorded function has set itself are set again by a replay.
            self._states[0] = (now, self._states[0][1])
        else:
            found = next((state for state in self._states if state[0] == now), None) or (now, next(_NUMBERS))
            self._states = [found, *(state for state in self._states if state is not found)][:_REMEMBERED]
        return f"unseen {self._states[0][1]}"


# Numbers for states of objects, and the number of states that one object remembers.
_NUMBERS, _REMEMBERED = count(1), 64


class _Off:
    """Watch over a parameter that may have been 0 all the time. A new value is read back to the host."""

    def __init__(self, table: mi.SceneParameters, key: str) -> None:
        self._table, self._key, self._still = table, key, True
        self._known: object = None

    def still(self) -> bool:
        """True if the parameter has always been 0."""
        if self._still:
            value = self._table[self._key]
            now = fingerprint(value)
            if now != self._known and not dr.flag(dr.JitFlag.FreezingScope):  # where nothing can be read
                self._known, self._still = now, bool(dr.all(dr.detach(value) == 0))
        return self._still


def _switched(node: mi.Object) -> list[mi.BSDF]:
    """Those among a BSDF and the BSDFs inside it with lobes that Mitsuba switches on when their parameters change."""
    if not isinstance(node, mi.BSDF):
        return []
    own = [node] if node.class_name().startswith("Principled") else []
    return [*own, *(found for _, child in children(node) for found in _switched(child))]


def _is_tracked(node: mi.Object, key: str, value: object) -> bool:
    if key.endswith("sampling_weight"):
        return True  # has no effect on images
    if node.class_name().startswith("Sunsky") and key in ("turbidity", "albedo.value"):
        return False
    if "nested_texture." in key or is_attribute(node, key):
        return False
    return dr.is_array_v(value) or isinstance(value, mi.Transform4f)

"""Frozen functions (``dr.freeze``) of records, without two faults of Dr.Jit 1.5 in its handling of records.

Dr.Jit asks Python for the fields of dataclasses while it holds its own lock. Another thread that holds Python's lock and waits
for Dr.Jit's lock, if only to drop an array, would wait forever. And if an input is the same object as an earlier one, a recording
ignores which one (``docs/dr-jit-faults/aliases.py``): small numbers and ``True`` often are. So ``dr.freeze`` is given a text that
describes the structure, and a plain list of arrays and of Mitsuba's objects.
"""

from __future__ import annotations

import enum
from collections.abc import Callable
from itertools import count
from typing import Any, cast

import drjit as dr

from .gc import gc_paused
from .pytree import ArrayTuple, StaticTuple, arrays_of, cached_by_type, fields_of, tree_map
from .types import AnyArray, PyTree

# Attribute of a record in which its findings are stored.
_FINDINGS = "_recording_findings"
_PLAIN = (int, float, complex, str, bytes, type(None), enum.Enum, type)


def recordings_of(function: Callable[..., Any]) -> int:
    """Number of recordings of a function decorated with ``dr.freeze``. The decorator's stub hides the attribute."""
    return int(cast(Any, function).n_recordings)


class freeze:
    """As ``dr.freeze``, but Python's garbage is not collected during calls: see `gc_paused`."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._recorded = dr.freeze(function)

    def __call__(self, *arguments: Any, **named: Any) -> Any:  # Any: those of the function
        with gc_paused():
            return self._recorded(*arguments, **named)

    @property
    def n_recordings(self) -> int:
        """Number of recordings so far."""
        return recordings_of(self._recorded)


class Frozen:
    """A function of records, recorded once for all arguments that differ only in the contents of their arrays.

    The function returns records, too. It may attach gradients to its arguments. Values that it stores in their attributes are
    stored when it is recorded, but not when it is replayed.
    """

    def __init__(self, function: Callable[..., PyTree]) -> None:
        call = _Call(function)

        def recorded(key: str, leaves: list[PyTree]) -> tuple[str, list[AnyArray]]:
            return call.run()

        self._call, self._recorded = call, dr.freeze(recorded)

    def __call__(self, *arguments: PyTree) -> PyTree:
        call = self._call
        call.arguments = arguments
        try:
            key, leaves = take_apart(arguments)
            # Dr.Jit distinguishes evaluated and unevaluated inputs, and would record once for each.
            dr.eval([leaf for leaf in leaves if dr.is_array_v(leaf)])
            with gc_paused():
                number, arrays = self._recorded(key, leaves)
        finally:
            call.arguments = ()
        given = iter(arrays)
        return tree_map(call.results[int(number)], lambda array: next(given))

    @property
    def n_recordings(self) -> int:
        """Number of recordings so far."""
        return recordings_of(self._recorded)


class _Call:
    """Records beside the arrays of a recording: the current arguments, and the ``results`` of all recordings."""

    def __init__(self, function: Callable[..., PyTree]) -> None:
        self.function = function
        self.arguments: tuple[PyTree, ...] = ()
        self.results: list[PyTree] = []

    def run(self) -> tuple[str, list[AnyArray]]:
        """Call the function; returns (index of its result in ``results``, arrays of the result)."""
        result = self.function(*self.arguments)
        arrays = arrays_of(result)
        # Empty arrays take the place of the result's own, which would stay in memory.
        self.results.append(tree_map(result, lambda array: type(array)()))
        return str(len(self.results) - 1), arrays


def take_apart(record: PyTree) -> tuple[str, list[PyTree]]:
    """(text that describes everything in a record but the contents of its leaves, leaves).

    Leaves are Dr.Jit's arrays and records, Mitsuba's objects, and all other objects that no text describes. The text also says
    which leaves are the same object. Objects with a method ``recording_text`` give their own text. Records of classes that are
    ``RECORDED_OFTEN`` store their findings, if nothing in them can change.
    """
    taken = _Taken()
    taken.walk(record)
    return " ".join(taken.texts), taken.leaves


class _Taken:
    """Findings of :func:`take_apart`. (An inner function that calls itself would be garbage that holds arrays.)

    ``changing``: whether a later walk through the same records may find another text.
    """

    def __init__(self) -> None:
        self.texts: list[str] = []
        self.leaves: list[PyTree] = []
        self.changing = False
        self._numbers: dict[int, int] = {}

    def walk(self, value: PyTree) -> None:
        kind = type(value)
        names = _parts_of(kind)
        if names:
            if not (_is_kept(kind) and self._take(value, kind, names)):
                self._walk_parts(value, kind, names)
        elif names is None:
            self.texts.append(repr(value))
        elif kind is tuple:
            self._walk_items(value)
        elif kind is ArrayTuple:
            self._take_arrays(value)
        elif kind is list:
            self.changing = True
            self._walk_items(value)
        elif kind is dict:
            self.changing = True
            self.texts.append(f"dict{len(value)}")
            for name, item in value.items():
                self.texts.append(repr(name))
                self.walk(item)
        elif _tells(kind):
            self.changing |= kind is not StaticTuple
            self.texts.append(value.recording_text())
        else:
            number = self._numbers.setdefault(id(value), len(self.leaves))
            self.texts.append(f"#{number}")
            if number == len(self.leaves):
                self.leaves.append(value)

    def _take_arrays(self, value: ArrayTuple) -> None:
        """The leaves of a tuple of arrays, all at once if they are new."""
        identities = [id(array) for array in value]
        if len(set(identities)) < len(value) or not self._numbers.keys().isdisjoint(identities):
            self._walk_items(value)
            return
        first = len(self.leaves)
        self._numbers.update(zip(identities, count(first), strict=False))
        self.leaves += value
        self.texts.append(f"{first}+{len(value)}")

    def _walk_items(self, value: PyTree) -> None:
        self.texts.append(f"{type(value).__name__}{len(value)}")
        for item in value:
            self.walk(item)

    def _walk_parts(self, value: PyTree, kind: type, names: tuple[str, ...]) -> None:
        self.texts.append(kind.__qualname__)
        self.changing |= not _is_frozen(kind)
        for name in names:
            self.walk(getattr(value, name))

    def _take(self, value: PyTree, kind: type, names: tuple[str, ...]) -> bool:
        """Take the findings of a record that are stored with it, or store them. False, and nothing is done, if a leaf was found
        before: it has a number already."""
        found: tuple[str, list[PyTree], list[int]] | None = vars(value).get(_FINDINGS)
        if found is None:
            own = _Taken()
            own._walk_parts(value, kind, names)
            found = " ".join(own.texts), own.leaves, [id(leaf) for leaf in own.leaves]
            if own.changing:
                self.changing = True
            else:
                object.__setattr__(value, _FINDINGS, found)
        text, leaves, identities = found
        if not self._numbers.keys().isdisjoint(identities):
            return False
        first = len(self.leaves)
        self._numbers.update(zip(identities, count(first), strict=False))
        self.leaves += leaves
        self.texts.append(f"{first}({text})")
        return True


@cached_by_type
def _tells(kind: type) -> bool:
    """True if objects of a class give their own text."""
    return hasattr(kind, "recording_text")


@cached_by_type
def _is_kept(kind: type) -> bool:
    """True for dataclasses of which an object serves many calls. They say so by ``RECORDED_OFTEN``."""
    return bool(getattr(kind, "RECORDED_OFTEN", False))


@cached_by_type
def _is_frozen(kind: type) -> bool:
    """True for dataclasses whose fields never change. Any other class may change."""
    return bool(getattr(getattr(kind, "__dataclass_params__", None), "frozen", False))


@cached_by_type
def _parts_of(kind: type) -> tuple[str, ...] | None:
    """Names of the fields of a dataclass, an empty tuple for other types, None for types whose ``repr`` is complete.

    Dataclasses may name other attributes in ``RECORDED``, those that recordings depend on.
    """
    if issubclass(kind, _PLAIN):
        return None
    return () if _tells(kind) else getattr(kind, "RECORDED", None) or fields_of(kind) or ()

"""Recording functions of records with ``dr.freeze``, safe from what Dr.Jit 1.5 makes of records.

Dr.Jit asks Python for the fields of dataclasses while it holds its own lock. Another thread that holds Python's lock and waits
for Dr.Jit's, if only to drop an array, would wait forever. And Dr.Jit does not see which of its earlier inputs an input is, if it
is one of them (``docs/dr-jit-faults/aliases.py``): small numbers and ``True`` often are. So it gets a text, which says all of
this, and a plain list of arrays and of Mitsuba's objects.
"""

from __future__ import annotations

import enum
import functools
from collections.abc import Callable
from typing import Any

import drjit as dr

from .gc import gc_paused
from .pytree import fields_of, tree_map

_PLAIN = (int, float, complex, str, bytes, type(None), enum.Enum, type)


class Frozen:
    """A function of records, recorded once for all that differ in the numbers of their arrays alone.

    What it returns are records, too. It may attach gradients to its arguments, but what it stores in their attributes is stored
    when it is recorded and not when it is replayed.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        call = _Call(function)

        def recorded(key: str, leaves: list[Any]) -> Any:
            return call.run()

        self._call, self._recorded = call, dr.freeze(recorded)

    def __call__(self, *arguments: Any) -> Any:
        call = self._call
        call.arguments = arguments
        try:
            key, leaves = take_apart(arguments)
            # An array that is yet to be worked out would be another input than the same one later.
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
        return int(self._recorded.n_recordings)


class _Call:
    """Inputs of a recording beside its arrays: the arguments and ``results``, as records."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function
        self.arguments: tuple[Any, ...] = ()
        self.results: list[Any] = []

    def run(self) -> tuple[str, list[Any]]:
        """Call the function. (Number of the result among all, its arrays)."""
        result, arrays = self.function(*self.arguments), []
        tree_map(result, lambda array: arrays.append(array) or array)
        # Without its arrays, which would stay in memory.
        self.results.append(tree_map(result, lambda array: type(array)()))
        return str(len(self.results) - 1), arrays


def take_apart(record: Any) -> tuple[str, list[Any]]:
    """(text that tells everything of a record but the contents of its leaves, leaves).

    Leaves are Dr.Jit's arrays and records, Mitsuba's objects, and whatever else no text describes. The text also says which
    leaves are the same one. Objects with a method ``recording_text`` give their own text.
    """
    taken = _Taken()
    taken.walk(record)
    return " ".join(taken.texts), taken.leaves


class _Taken:
    """Findings of :func:`take_apart`. (An inner function that calls itself would be garbage that holds arrays.)"""

    def __init__(self) -> None:
        self.texts: list[str] = []
        self.leaves: list[Any] = []
        self._numbers: dict[int, int] = {}

    def walk(self, value: Any) -> None:
        kind = type(value)
        names = _parts_of(kind)
        if names is None:
            self.texts.append(repr(value))
        elif kind is tuple or kind is list:
            self.texts.append(f"{kind.__name__}{len(value)}")
            for item in value:
                self.walk(item)
        elif kind is dict:
            self.texts.append(f"dict{len(value)}")
            for name, item in value.items():
                self.texts.append(repr(name))
                self.walk(item)
        elif names:
            self.texts.append(kind.__qualname__)
            for name in names:
                self.walk(getattr(value, name))
        elif hasattr(kind, "recording_text"):
            self.texts.append(value.recording_text())
        else:
            number = self._numbers.setdefault(id(value), len(self.leaves))
            self.texts.append(f"#{number}")
            if number == len(self.leaves):
                self.leaves.append(value)


@functools.cache
def _parts_of(kind: type) -> tuple[str, ...] | None:
    """Names of the fields of a dataclass, no names for other types, None for those whose ``repr`` tells everything."""
    if issubclass(kind, _PLAIN):
        return None
    return () if hasattr(kind, "recording_text") else fields_of(kind) or ()

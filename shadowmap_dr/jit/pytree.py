"""Trees of records as lists of arrays, and copies of trees with other arrays."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from collections.abc import Callable
from itertools import count
from typing import Any, TypeVar

import drjit as dr

from .types import AnyArray, PyTree

ResultT = TypeVar("ResultT")
RecordT = TypeVar("RecordT")
# Roles of values in trees.
_ARRAY, _ARRAYS, _TRANSFORM, _SEQUENCE, _MAPPING, _RECORD, _STRUCT, _OTHER = range(8)


class StaticTuple(tuple[ResultT, ...]):
    """A tuple of records without arrays. Functions of trees do not look into it, and its text for recordings is made once."""

    def recording_text(self) -> str:
        """All fields of the records. A walk through those of 5,000 records at each rendering would take 0.1 s."""
        found: str | None = vars(self).get("text")
        if found is None:
            found = vars(self)["text"] = hashlib.sha256(repr(tuple(self)).encode()).hexdigest()
        return found


class ArrayTuple(tuple[AnyArray, ...]):
    """A tuple of Dr.Jit's arrays and nothing else. Recordings take all of its arrays at once."""


def tree_map(value: PyTree, function: Callable[[AnyArray], AnyArray]) -> PyTree:
    """A copy of a tree with ``function`` applied to all Dr.Jit arrays in it, in a fixed order.

    Trees are made of dataclasses, tuples, lists, dictionaries, transformations and Mitsuba's records. Other objects, and records
    whose arrays are all unchanged, are shared with the copy.
    """
    role = _role_of(type(value))
    if role == _ARRAY:
        return function(value)
    if role == _OTHER:
        return value
    if role == _RECORD:
        old = vars(value)
        new = {name: tree_map(old[name], function) for name in fields_of(type(value)) or ()}
        for name, item in new.items():
            if item is not old[name]:
                break
        else:
            return value
        return _record_of(type(value), new)
    if role == _ARRAYS:
        return ArrayTuple(map(function, value))
    if role == _SEQUENCE:
        return type(value)([tree_map(item, function) for item in value])
    if role == _MAPPING:
        return {key: tree_map(item, function) for key, item in value.items()}
    if role == _TRANSFORM:
        matrix = function(value.matrix)
        return value if matrix is value.matrix else type(value)(type(value.matrix)(matrix))
    # Mitsuba's records can be changed, but not constructed from their fields.
    struct = type(value)(value)
    for name in type(value).DRJIT_STRUCT:
        setattr(struct, name, tree_map(getattr(value, name), function))
    return struct


def with_fields(record: RecordT, **values: Any) -> RecordT:  # Any: fields of different types
    """A copy of a dataclass with other values of some fields.

    For records that each step of a loop copies: ``dataclasses.replace`` takes five times as long, since it calls ``__init__``.
    """
    old = vars(record)
    new = {name: old[name] for name in fields_of(type(record)) or ()}
    if not new.keys() >= values.keys():
        raise TypeError(f"{type(record).__name__} has no field {', '.join(values.keys() - new.keys())}.")
    return _record_of(type(record), new | values)


def _record_of(kind: type[RecordT], values: dict[str, Any]) -> RecordT:  # Any: as above
    """A dataclass of these values, made without its ``__init__``."""
    record = object.__new__(kind)
    vars(record).update(values)
    return record


def cached_by_type(function: Callable[[type], ResultT]) -> Callable[[type], ResultT]:
    """``functools.cache`` for functions of a class; mypy does not take a class for hashable."""
    return functools.cache(function)


@cached_by_type
def fields_of(kind: type) -> tuple[str, ...] | None:
    """Names of the fields of a dataclass, None for other classes. Cached, for every optimisation step asks for them."""
    return tuple(field.name for field in dataclasses.fields(kind)) if dataclasses.is_dataclass(kind) else None


@cached_by_type
def _role_of(kind: type) -> int:
    """Role of the values of a class in a tree. A walk through a tree at each step asks for it thousands of times."""
    if dr.is_array_v(kind):
        return _ARRAY
    if kind.__name__ == "Transform4f":  # of any variant
        return _TRANSFORM
    if issubclass(kind, StaticTuple):
        return _OTHER
    if issubclass(kind, ArrayTuple):
        return _ARRAYS
    if issubclass(kind, tuple | list):
        return _SEQUENCE
    if issubclass(kind, dict):
        return _MAPPING
    if fields_of(kind) is not None:
        return _RECORD
    return _OTHER if getattr(kind, "DRJIT_STRUCT", None) is None else _STRUCT


def arrays_of(tree: PyTree) -> list[AnyArray]:
    """All arrays of a tree, in the order of :func:`tree_map`."""
    found: list[AnyArray] = []

    def collect(array: AnyArray) -> AnyArray:
        found.append(array)
        return array

    tree_map(tree, collect)
    return found


def attached_arrays(record: PyTree) -> list[AnyArray]:
    """The attached arrays of a tree, in the order of :func:`tree_map`."""
    return attached_places(record)[1]


def attached_places(record: PyTree) -> tuple[tuple[int, ...], list[AnyArray]]:
    """(positions of the attached arrays in the order of :func:`tree_map`, counted from 0; these arrays)."""
    places, found, place = [], [], count()

    def collect(array: AnyArray) -> AnyArray:
        here = next(place)
        if _attached(array):
            places.append(here)
            found.append(array)
        return array

    tree_map(record, collect)
    return tuple(places), found


def attached_of(tree: PyTree, places: tuple[int, ...]) -> list[AnyArray]:
    """The arrays at some places of a tree, counted in the order of :func:`tree_map`."""
    found = arrays_of(tree)
    return [found[place] for place in places]


def attached_copies(tree: PyTree, places: tuple[int, ...]) -> list[AnyArray]:
    """Copies of :func:`attached_of` that begin a graph of their own."""
    copies = [type(array)(array) for array in attached_of(tree, places)]
    dr.enable_grad(copies)
    return copies


def with_arrays(record: PyTree, arrays: list[AnyArray]) -> PyTree:
    """A copy of a tree with ``arrays`` in the place of its :func:`attached_arrays`."""
    position = iter(arrays)
    return tree_map(record, lambda array: next(position) if _attached(array) else array)


def with_places(record: PyTree, places: tuple[int, ...], arrays: list[AnyArray]) -> PyTree:
    """A copy of a tree with ``arrays`` at positions ``places`` (:func:`attached_places`), which need not be attached here."""
    wanted, place = dict(zip(places, arrays, strict=True)), count()
    return tree_map(record, lambda array: wanted.get(next(place), array))


def _attached(array: AnyArray) -> bool:
    return dr.is_float_v(array) and dr.grad_enabled(array)

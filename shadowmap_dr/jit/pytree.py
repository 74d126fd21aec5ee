"""Taking trees of records apart into arrays, and putting them together again with others."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from itertools import count
from typing import Any

import drjit as dr
import mitsuba as mi


def tree_map(value: Any, function: Callable[[Any], Any]) -> Any:
    """A copy of a tree with ``function`` applied to all Dr.Jit arrays in it, in a fixed order.

    Trees are made of dataclasses, tuples, lists, dictionaries, transformations and Mitsuba's records; other things in them, and
    parts of which no array has changed, stay the very same objects.
    """
    if dr.is_array_v(value):
        return function(value)
    if isinstance(value, mi.Transform4f):
        matrix = function(value.matrix)
        return value if matrix is value.matrix else mi.Transform4f(mi.Matrix4f(matrix))
    if isinstance(value, tuple | list):
        return type(value)([tree_map(item, function) for item in value])
    if isinstance(value, dict):
        return {key: tree_map(item, function) for key, item in value.items()}
    fields = fields_of(type(value))
    if fields is not None:
        old = [getattr(value, name) for name in fields]
        new = [tree_map(item, function) for item in old]
        if all(a is b for a, b in zip(old, new, strict=True)):
            return value
        return dataclasses.replace(value, **dict(zip(fields, new, strict=True)))
    names = getattr(type(value), "DRJIT_STRUCT", None)
    if names is None:
        return value
    # Mitsuba's records can be changed, but not constructed from their fields.
    changed = type(value)(value)
    for name in names:
        setattr(changed, name, tree_map(getattr(value, name), function))
    return changed


@functools.cache
def fields_of(kind: type) -> tuple[str, ...] | None:
    """Names of the fields of a dataclass, None for other classes. Asked for again and again, at every step of an optimisation."""
    return tuple(field.name for field in dataclasses.fields(kind)) if dataclasses.is_dataclass(kind) else None


def attached_arrays(record: Any) -> list[Any]:
    """The arrays of a tree through which gradients flow, in a fixed order."""
    return attached_places(record)[1]


def attached_places(record: Any) -> tuple[tuple[int, ...], list[Any]]:
    """(where :func:`tree_map` comes to arrays through which gradients flow, counted from 0, and these arrays)."""
    places, found, place = [], [], count()

    def collect(array: Any) -> Any:
        here = next(place)
        if _attached(array):
            places.append(here)
            found.append(array)
        return array

    tree_map(record, collect)
    return tuple(places), found


def with_arrays(record: Any, arrays: list[Any]) -> Any:
    """The same tree with others in the place of :func:`attached_arrays`."""
    position = iter(arrays)
    return tree_map(record, lambda array: next(position) if _attached(array) else array)


def with_places(record: Any, places: tuple[int, ...], arrays: list[Any]) -> Any:
    """The same tree with others in the place of arrays of :func:`attached_places`, which need not be attached."""
    wanted, place = dict(zip(places, arrays, strict=True)), count()
    return tree_map(record, lambda array: wanted.get(next(place), array))


def _attached(array: Any) -> bool:
    return dr.is_float_v(array) and dr.grad_enabled(array)

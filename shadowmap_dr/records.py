"""Taking trees of frozen dataclasses apart into differentiable arrays, and putting them together again with others."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import drjit as dr


def attached_arrays(record: Any) -> list[Any]:
    """The arrays of a tree (dataclasses, tuples, Mitsuba's records) through which gradients flow, in a fixed order."""
    found: list[Any] = []

    def collect(leaf: Any) -> Any:
        found.append(leaf)
        return leaf

    _map(record, collect)
    return found


def with_arrays(record: Any, arrays: list[Any]) -> Any:
    """The same tree with others in the place of :func:`attached_arrays`."""
    position = iter(arrays)
    return _map(record, lambda _: next(position))


def _map(value: Any, function: Callable[[Any], Any]) -> Any:
    if dr.is_array_v(value):
        return function(value) if dr.is_float_v(value) and dr.grad_enabled(value) else value
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {field.name: _map(getattr(value, field.name), function) for field in dataclasses.fields(value)}
        return dataclasses.replace(value, **fields)
    if isinstance(value, tuple):
        return tuple(_map(item, function) for item in value)
    names = getattr(type(value), "DRJIT_STRUCT", None)
    if names is None:
        return value
    # Mitsuba's records can be changed, but not constructed from their fields.
    changed = type(value)(value)
    for name in names:
        setattr(changed, name, _map(getattr(value, name), function))
    return changed

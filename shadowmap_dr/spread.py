"""Single values that meet wide arrays, made cheap to differentiate."""

from __future__ import annotations

import dataclasses
from typing import Any

import drjit as dr
import mitsuba as mi

from .tables import look_up, one_buffer


def spread(record: Any, width: int) -> Any:
    """A copy of ``record`` whose differentiable numbers of width 1 are gathered ``width`` times from one common buffer.

    ``record`` is a Dr.Jit array, a ``mi.Transform4f`` or a dataclass, tuple, list or dict of them. Values and gradients are the
    same as with implicit broadcasting. The difference is the backward pass: the adjoint of broadcasting sums over all lanes,
    which evaluates the whole graph anew for *each* number (a direction has three), while the adjoint of a gather is a
    scatter, and those of all numbers run in one kernel. Records without gradients are returned as they are.
    """
    leaves: list[Any] = []

    def collect(leaf: Any) -> Any:
        leaves.append(leaf)
        return leaf

    _map(record, collect)
    if not leaves or width == 1:
        return record
    flat = one_buffer(leaves)
    position = iter(range(len(leaves)))
    return _map(record, lambda _: look_up(flat, dr.full(mi.UInt32, next(position), width)))


def _map(value: Any, function: Any) -> Any:
    """Apply a function to all differentiable single numbers in a tree; parts without any are kept as they are."""
    if isinstance(value, mi.Transform4f):
        matrix = _map(value.matrix, function)
        return value if matrix is value.matrix else mi.Transform4f(mi.Matrix4f(matrix))
    if dr.is_array_v(value):
        if dr.is_tensor_v(value) or not dr.is_float_v(value) or not dr.grad_enabled(value):
            return value
        if dr.depth_v(value) == 1:
            return function(value) if dr.width(value) == 1 else value
        return type(value)(*(_map(value[i], function) for i in range(len(value))))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {field.name: _map(getattr(value, field.name), function) for field in dataclasses.fields(value)}
        return dataclasses.replace(value, **fields)
    if isinstance(value, tuple | list):
        return type(value)(_map(item, function) for item in value)
    if isinstance(value, dict):
        return {key: _map(item, function) for key, item in value.items()}
    return value

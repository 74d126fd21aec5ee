"""Single values that meet wide arrays, made cheap to differentiate."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .raster._types import backend
from .records import map_arrays
from .tables import LIKE_LANES, copy_of_lane, in_copies, look_up, one_buffer


def spread(record: Any, width: int) -> Any:
    """A copy of ``record`` whose differentiable numbers of width 1 are gathered ``width`` times from one common buffer.

    ``record`` is a Dr.Jit array, a ``mi.Transform4f`` or a dataclass, tuple, list or dict of them. Values and gradients are the
    same as with implicit broadcasting. The difference is the backward pass: the adjoint of broadcasting sums over all lanes,
    which evaluates the whole graph anew for *each* number (a direction has three), while the adjoint of a gather is a
    scatter, and those of all numbers run in one kernel. Records without gradients are returned as they are.
    """
    leaves: list[Any] = []

    def collect(number: Any) -> Any:
        leaves.append(number)
        return number

    map_arrays(record, lambda array: _map_numbers(array, collect))
    if not leaves or width == 1:
        return record
    flat = one_buffer(leaves)
    numbers = dr.width(flat)
    (flat,), copies = in_copies([flat], width, LIKE_LANES)
    first = copy_of_lane(backend(flat), width, copies, LIKE_LANES) * numbers
    position = iter(range(len(leaves)))

    def wide(number: Any) -> Any:
        return look_up(flat, dr.full(mi.UInt32, next(position), width) + first)

    return map_arrays(record, lambda array: _map_numbers(array, wide))


def _map_numbers(array: Any, function: Any) -> Any:
    """Apply a function to all differentiable single numbers of an array; parts without any are kept as they are."""
    if dr.is_tensor_v(array) or not dr.is_float_v(array) or not dr.grad_enabled(array):
        return array
    if dr.depth_v(array) == 1:
        return function(array) if dr.width(array) == 1 else array
    return type(array)(*(_map_numbers(array[i], function) for i in range(len(array))))

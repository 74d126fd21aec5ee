"""Look-ups of many lanes in small tables, with exact adjoints.

Dr.Jit's default would lose a part of the derivatives for two reasons.

On the LLVM backend, ``dr.gather`` has a special adjoint for small arrays (``ReduceMode.Expand``, the default there): each thread
sums in a private copy. Dr.Jit 1.5 loses a part of that sum, depending on which thread runs it, if the array has been read before
and the incoming gradient is itself such a sum that is not evaluated yet. That happens if the result of one look-up is the table
of the next. So tables are read in another mode here (:func:`look_up`). And the caller's arrays never receive such a sum
(:func:`from_one_buffer`), for the caller may read them in the default mode.

Second, a single-precision sum that grows term by term rounds each term to the last digit of the sum: millions of equal terms are
all rounded in the same direction. So each block of lanes adds to its own copy of the table (:func:`in_copies`). The copies are
summed at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import ModuleType
from typing import TypeVar, cast

import drjit as dr
import mitsuba as mi

from .arrays import backend
from .kernel_inputs import SharingOp, split, uint_input
from .pytree import tree_map
from .types import AnyArray, Float, PyTree, UInt32

_ArrayT = TypeVar("_ArrayT", bound="AnyArray")

#: Lanes that add to one copy of a table of vertices, cameras or texels, whose gradients differ from lane to lane. A power of two.
LANES = 1 << 20
#: Lanes that add to one copy where all terms may be equal, such as those of a light's intensity. A power of two.
LIKE_LANES = 1 << 18
# Least number of lanes of such a block, and blocks from which on blocks become larger: threads that add to copies of their own do
# not wait for each other.
_FEW_LANES, _BLOCKS = 1 << 14, 32
# Numbers of a cache line. No two copies of a table for all lanes share one.
_LINE = 16
# Most numbers in the copies of an array for threads.
_MOST_IN_COPIES = 1 << 26


def look_up(column: Float, index: UInt32) -> Float:
    """``column[index]`` for a small array and valid indices. Attached to the column."""
    return dr.gather(type(column), column, index, mode=dr.ReduceMode.Local)


def copies_for_threads(array: Float) -> dr.ReduceMode:
    """Mode of look-ups by many lanes in a large array: on a CPU each thread adds gradients to a copy of its own.

    Atomic additions take longer. Dr.Jit makes such copies of arrays of up to a million numbers; here all copies may have 256 MiB.
    """
    if dr.backend_v(array) == dr.JitBackend.LLVM and dr.width(array) * dr.thread_count() <= _MOST_IN_COPIES:
        return dr.ReduceMode.Expand
    return dr.ReduceMode.Auto


def one_buffer(columns: Sequence[Float], multiple: int = 1) -> Float:
    """The numbers of ``Float`` arrays one after the other, then zeros, up to a ``multiple``.

    Attached; each array receives its gradient as a part of a buffer.
    """
    # At least one zero makes this a copy even for a single column.
    zeros = 1 + (-sum(dr.width(column) for column in columns) - 1) % multiple
    return dr.concat([*columns, dr.zeros(type(columns[0]), zeros)])


def from_one_buffer(columns: Sequence[Float]) -> list[Float]:
    """Copies of ``Float`` arrays of the same width. Attached; the columns receive their gradients as parts of a buffer."""
    buffer, rows = one_buffer(columns), dr.width(columns[0])
    row = dr.arange(backend(buffer).UInt32, rows)
    return [dr.gather(type(c), buffer, row + k * rows, mode=dr.ReduceMode.NoConflicts) for k, c in enumerate(columns)]


def like_lanes(lanes: int) -> int:
    """Lanes that add to one copy of a table where all of so many lanes read the same numbers, a power of two."""
    return min(max(_FEW_LANES, 1 << (lanes // _BLOCKS).bit_length()), LIKE_LANES)


def in_copies(arrays: Sequence[Float], lanes: int, block: int = LANES) -> tuple[list[Float], int]:
    """Copies of flat ``Float`` arrays, one for each block of lanes that look numbers up in them (:func:`copy_of_lane`).

    Make all copies before the computations of the lanes. The backward pass runs in reverse order, and recomputes the lanes for
    each separate sum of copies.

    Args:
        arrays: tables.
        lanes: number of lanes that look numbers up.
        block: number of lanes that share a copy, a power of two.

    Returns:
        (for each array, a buffer of its copies one after the other; number of copies, 1 if no array is attached). Attached.
    """
    count = -(-lanes // block)
    if count == 1 or not dr.grad_enabled(list(arrays)):
        return list(arrays), 1
    return dr.custom(Copies, list(arrays), count, False), count


def copy_of_lane(module: ModuleType, lanes: int, copies: int, block: int = LANES) -> UInt32:
    """Index of the copy that each lane reads; the constant 0 if there is only one."""
    if copies == 1:
        return module.UInt32(0)
    shift, last = uint_input(module, "lanes of a copy", block.bit_length() - 1), uint_input(module, "last copy", copies - 1)
    return dr.minimum(dr.arange(module.UInt32, lanes) >> shift, last)


class Copies(SharingOp):
    """Copies of arrays, one after the other, or (``transpose``) the sums of such copies: each is the adjoint of the other.

    Dr.Jit's own adjoint of a repeated gather would use atomics.
    """

    def eval(self, arrays: list[Float], count: int, transpose: bool) -> list[Float]:
        self._arguments = count, transpose
        return self._apply(arrays, transpose)

    def forward(self) -> None:
        self.set_grad_out(self._apply(cast(list[Float], self.grad_in("arrays")), self._arguments[1]))

    def backward(self) -> None:
        self.set_grad_in("arrays", self._apply(cast(list[Float], self.grad_out()), not self._arguments[1]))

    def name(self) -> str:
        return "copies"

    def _apply(self, arrays: list[Float], transpose: bool) -> list[Float]:
        dr.eval(arrays)  # together: gathers would evaluate one by one
        return [(sum_of_copies if transpose else copied)(array, self._arguments[0]) for array in arrays]


def copied(array: _ArrayT, count: int) -> _ArrayT:
    """``count`` copies of an array (N) of any Dr.Jit type, one after the other (N * count)."""
    width = dr.width(array)
    _, place = split(dr.arange(backend(array).UInt32, count * width), "width of a copy", width, count)
    return dr.gather(type(array), array, place)


def sum_of_copies(array: _ArrayT, count: int) -> _ArrayT:
    """The sum (N) of ``count`` arrays that lie one after the other (N * count)."""
    width = dr.width(array) // count
    module = backend(array)
    lane, step = dr.arange(module.UInt32, width), uint_input(module, "width of a copy", width)
    return cast(_ArrayT, sum(dr.gather(type(array), array, lane + k * step) for k in range(count)))


def broadcast_differentiable(record: PyTree, width: int) -> PyTree:
    """A copy of ``record`` whose attached numbers of width 1 are gathered ``width`` times from one common buffer.

    ``record`` is a Dr.Jit array, a ``mi.Transform4f`` or a dataclass, tuple, list or dict of them. Values and gradients are the
    same as with implicit broadcasting, but the backward pass is faster. The adjoint of broadcasting is a sum over all lanes: the
    whole graph is evaluated again for *each* number (a direction has three). The adjoint of a gather is a scatter, and the
    scatters of all numbers run in one kernel. Detached records are returned unchanged.
    """
    leaves: list[Float] = []

    def collect(number: Float) -> Float:
        leaves.append(number)
        return number

    tree_map(record, lambda array: _map_numbers(array, collect))
    if not leaves or width == 1:
        return record
    flat, block = one_buffer(leaves, _LINE), like_lanes(width)
    numbers = dr.width(flat)
    (flat,), copies = in_copies([flat], width, block)
    first = copy_of_lane(backend(flat), width, copies, block) * uint_input(backend(flat), "numbers of a copy", numbers)
    position = iter(range(len(leaves)))

    def wide(number: Float) -> Float:
        return look_up(flat, dr.full(mi.UInt32, next(position), width) + first)

    return tree_map(record, lambda array: _map_numbers(array, wide))


def _map_numbers(array: AnyArray, function: Callable[[Float], Float]) -> AnyArray:
    """Apply a function to all attached numbers of width 1 in an array; other components are kept."""
    if dr.is_tensor_v(array) or not dr.is_float_v(array) or not dr.grad_enabled(array):
        return array
    if dr.depth_v(array) == 1:
        return function(cast(Float, array)) if dr.width(array) == 1 else array
    return type(array)(*(_map_numbers(array[i], function) for i in range(len(array))))

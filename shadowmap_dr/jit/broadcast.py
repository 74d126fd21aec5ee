"""Small tables that many lanes look numbers up in, differentiable without loss.

Two things lose a part of the derivatives otherwise.

On the LLVM backend ``dr.gather`` has an adjoint of its own for small arrays (``ReduceMode.Expand``, its default there): each
thread sums up in memory of its own. Dr.Jit 1.5 loses a part of that sum, depending on the thread that comes to run it, where two
things meet: the array has been read before, and the incoming gradient is a sum of any such kind that is not evaluated yet, which
it is when what was looked up has itself served as a table. So tables are read in another mode here (:func:`look_up`), and what
the caller gave never receives such a sum (:func:`from_one_buffer`), since the caller may have looked it up in the default mode.

And a sum in single precision that grows term by term rounds each of them to its own last digit: with millions of like terms, all
in the same direction. So blocks of lanes add to a copy of the table each (:func:`in_copies`), and the copies are added up later.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType
from typing import Any

import drjit as dr
import mitsuba as mi

from .arrays import backend
from .pytree import tree_map

#: Lanes that add to one copy of a table of vertices, cameras or texels: their terms differ from lane to lane.
LANES = 1 << 20
#: The same where all terms may be equal, such as those by the strength of a light. A power of two, like the other.
LIKE_LANES = 1 << 18


def look_up(column: Any, index: Any) -> Any:
    """``column[index]`` for a small ``Float`` array and valid rows (``UInt32``). Attached to the column."""
    return dr.gather(type(column), column, index, mode=dr.ReduceMode.Local)


def one_buffer(columns: Sequence[Any]) -> Any:
    """The numbers of ``Float`` arrays one after the other. Attached; each receives its gradient as a part of a buffer."""
    # The number at the end makes a buffer even of a single column.
    return dr.concat([*columns, dr.zeros(type(columns[0]), 1)])


def from_one_buffer(columns: Sequence[Any]) -> list[Any]:
    """Copies of ``Float`` arrays of the same width. Attached; the columns receive their gradients as parts of a buffer."""
    buffer, rows = one_buffer(columns), dr.width(columns[0])
    row = dr.arange(backend(buffer).UInt32, rows)
    return [dr.gather(type(c), buffer, row + k * rows, mode=dr.ReduceMode.NoConflicts) for k, c in enumerate(columns)]


def in_copies(arrays: Sequence[Any], lanes: int, block: int = LANES) -> tuple[list[Any], int]:
    """Copies of flat ``Float`` arrays, one for each block of lanes that look numbers up in them (:func:`copy_of_lane`).

    Make them before what hangs on the lanes: derivatives are taken in the reverse order, and the lanes are worked out once more
    for each place where copies are added.

    Args:
        arrays: tables.
        lanes: number of the lanes that will look numbers up.
        block: of lanes that share a copy, a power of two.

    Returns:
        The copies of each array, one after the other in one buffer, and their number: 1 if no array is attached. Attached.
    """
    count = -(-lanes // block)
    if count == 1 or not dr.grad_enabled(list(arrays)):
        return list(arrays), 1
    return dr.custom(Copies, list(arrays), count, False), count


def copy_of_lane(module: ModuleType, lanes: int, copies: int, block: int = LANES) -> Any:
    """The copy (``UInt32``) that each lane is to read; a constant if there is but one."""
    if copies == 1:
        return module.UInt32(0)
    return dr.minimum(dr.arange(module.UInt32, lanes) >> (block.bit_length() - 1), copies - 1)


class Copies(dr.CustomOp):
    """Copies of arrays, one after the other, or (``transpose``) the sums of such copies: each is the adjoint of the other.

    Dr.Jit's own adjoint of a repeated gather would add up with atomics.
    """

    def eval(self, arrays: list[Any], count: int, transpose: bool) -> list[Any]:
        self._arguments = count, transpose
        return self._apply(arrays, transpose)

    def forward(self) -> None:
        self.set_grad_out(self._apply(self.grad_in("arrays"), self._arguments[1]))

    def backward(self) -> None:
        self.set_grad_in("arrays", self._apply(self.grad_out(), not self._arguments[1]))

    def name(self) -> str:
        return "copies"

    def _apply(self, arrays: list[Any], transpose: bool) -> list[Any]:
        return [(sum_of_copies if transpose else copied)(array, self._arguments[0]) for array in arrays]


def copied(array: Any, count: int) -> Any:
    """``count`` copies of an array (N) of any Dr.Jit type, one after the other (N * count)."""
    width = dr.width(array)
    lane = dr.arange(backend(array).UInt32, count * width)
    return dr.gather(type(array), array, lane - lane // width * width)


def sum_of_copies(array: Any, count: int) -> Any:
    """The sum (N) of ``count`` arrays that lie one after the other (N * count)."""
    width = dr.width(array) // count
    lane = dr.arange(backend(array).UInt32, width)
    return sum(dr.gather(type(array), array, lane + k * width) for k in range(count))


def broadcast_differentiable(record: Any, width: int) -> Any:
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

    tree_map(record, lambda array: _map_numbers(array, collect))
    if not leaves or width == 1:
        return record
    flat = one_buffer(leaves)
    numbers = dr.width(flat)
    (flat,), copies = in_copies([flat], width, LIKE_LANES)
    first = copy_of_lane(backend(flat), width, copies, LIKE_LANES) * numbers
    position = iter(range(len(leaves)))

    def wide(number: Any) -> Any:
        return look_up(flat, dr.full(mi.UInt32, next(position), width) + first)

    return tree_map(record, lambda array: _map_numbers(array, wide))


def _map_numbers(array: Any, function: Any) -> Any:
    """Apply a function to all differentiable single numbers of an array; parts without any are kept as they are."""
    if dr.is_tensor_v(array) or not dr.is_float_v(array) or not dr.grad_enabled(array):
        return array
    if dr.depth_v(array) == 1:
        return function(array) if dr.width(array) == 1 else array
    return type(array)(*(_map_numbers(array[i], function) for i in range(len(array))))

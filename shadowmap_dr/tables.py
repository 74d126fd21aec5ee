"""Small tables that many lanes look numbers up in, differentiable without loss.

On the LLVM backend ``dr.gather`` has an adjoint of its own for small arrays (``ReduceMode.Expand``, its default there): each
thread sums up in memory of its own. Dr.Jit 1.5 loses a part of that sum, depending on the thread that comes to run it, where two
things meet: the array has been read before, and the incoming gradient is a sum of any such kind that is not evaluated yet, which
it is when what was looked up has itself served as a table. So tables are read in another mode here (:func:`look_up`), and what
the caller gave never receives such a sum (:func:`from_one_buffer`), since the caller may have looked it up in the default mode.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr

from .raster._types import backend


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

"""Maxima and sums over groups of lanes. Several numbers share a buffer: a reduction costs more to launch than to run."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr

from ..jit.arrays import backend
from ..jit.types import Bool, Float, UInt32


def grouped_maxima(values: Sequence[Float], group: UInt32, count: int, active: Bool | bool = True) -> Float:
    """Maxima of several values over the lanes of each group (below ``count``), interleaved; minus infinity without lanes."""
    return _reduced(dr.ReduceOp.Max, -dr.inf, values, group, count, active)


def grouped_sums(values: Sequence[Float], group: UInt32, count: int, active: Bool | bool = True) -> Float:
    """Sums of several values over the lanes of each group (below ``count``), interleaved."""
    return _reduced(dr.ReduceOp.Add, 0, values, group, count, active)


def numbers_of(interleaved: Float, group: UInt32, size: int) -> list[Float]:
    """The ``size`` interleaved numbers of some groups."""
    return [dr.gather(backend(group).Float, interleaved, group * size + k) for k in range(size)]


def _reduced(op: dr.ReduceOp, start: float, values: Sequence[Float], group: UInt32, count: int, active: Bool | bool) -> Float:
    size = len(values)
    target = dr.full(backend(group).Float, start, size * count)
    for k, value in enumerate(values):
        dr.scatter_reduce(op, target, value, group * size + k, active)
    return target

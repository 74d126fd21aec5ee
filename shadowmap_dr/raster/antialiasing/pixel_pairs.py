"""Pairs of neighbouring pixels, and lists of the few among them that need work.

Pair ``2 * p`` consists of pixel ``p`` and its right neighbour, pair ``2 * p + 1`` of ``p`` and the lower one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from ...jit.arrays import backend
from ..types import RasterOutput

# A list's slots are dealt out in rounds to one lane for this many: short lists end after the first round.
_ROUNDS = 8
# So many neighbouring lanes work on so many neighbouring numbers.
_PACKET = 16


@dataclass(frozen=True)
class PairList:
    """Some of the pairs, in no particular order.

    Right pairs fill ``pairs`` from the front, down pairs from the back, or all pairs from the front: that makes ``front[0]`` and
    ``back[0]`` many. A list numbers them from 0 on, without a gap ("slots"). The sizes of the arrays do not depend on the data.
    """

    pairs: Any
    front: Any
    back: Any
    touched: Any = None

    def add_once(self, pair: Any, active: Any) -> None:
        """Add pairs that have not been added before. To be traced only once for a list."""
        UInt32 = backend(self.pairs).UInt32
        first = active & (dr.scatter_inc(self.touched, pair, active) == 0)
        dr.scatter(self.pairs, pair, dr.scatter_inc(self.front, UInt32(0), first), first)

    def for_each(self, visit: Callable[[Any, Any], None]) -> None:
        """Call ``visit(slot, pair)``, which writes somewhere, for all pairs in the list: full packets, whatever the image."""
        each_number(self.front + self.back, self.lanes, lambda slot: visit(slot, self.at(slot)))

    @property
    def lanes(self) -> int:
        """Number of lanes that deal with the list in turns."""
        return -(-dr.width(self.pairs) // _ROUNDS)

    def at(self, slot: Any) -> Any:
        """The pair in a slot."""
        index = dr.select(slot < self.front, slot, dr.width(self.pairs) - 1 - (slot - self.front))
        return dr.gather(type(slot), self.pairs, index)


def each_number(count: Any, lanes: int, visit: Callable[[Any], None]) -> None:
    """Call ``visit(number)``, which writes somewhere, for all ``UInt32`` below ``count``, at most about ``lanes`` at a time.

    Neighbouring lanes get neighbouring numbers, in packets, and each packet of lanes as many packets as any other: threads share
    the lanes out run by run, and all of them shall be busy even if there are few numbers.
    """
    module = backend(count)
    UInt32, UInt64 = module.UInt32, module.UInt64
    packets = -(-lanes // _PACKET)
    lane = dr.arange(UInt32, packets * _PACKET)
    packet = lane // _PACKET
    total = (count + (_PACKET - 1)) // _PACKET
    first, end = (UInt32(UInt64(p) * UInt64(total) // packets) * _PACKET for p in (packet, packet + 1))
    within = lane - packet * _PACKET

    def one(number: Any, end: Any) -> tuple[Any, Any]:
        visit(number)
        return number + _PACKET, end

    state = (first + within, dr.minimum(end, count))
    dr.while_loop(state, lambda number, end: number < end, one, mode="symbolic", label="pairs")


def empty_list(raster: RasterOutput) -> tuple[PairList, Any]:
    """A list to which pairs can be added, and for each pair a key (``UInt64``) of 0."""
    module = backend(raster.triangle)
    UInt32 = module.UInt32
    capacity = 2 * dr.width(raster.triangle)
    # Zeros that a kernel of all threads writes: faster than the one thread that fills an array with a constant.
    touched = dr.arange(UInt32, capacity) >> 31
    keys = module.UInt64(touched)
    dr.eval(touched, keys)
    return PairList(dr.empty(UInt32, capacity), dr.zeros(UInt32, 1), dr.zeros(UInt32, 1), touched), keys


def differing_pairs(raster: RasterOutput) -> tuple[PairList, Any]:
    """Pairs whose pixels see different triangles, and keys (``UInt64``), 0 for these pairs and undefined for others."""
    module = backend(raster.triangle)
    UInt32 = module.UInt32
    pixels = dr.width(raster.triangle)
    pixel = dr.arange(UInt32, pixels)
    row = pixel // raster.width
    column = pixel - row * raster.width
    if raster.batch > 1:
        row %= raster.height
    right, below = column + 1 < raster.width, row + 1 < raster.height
    here = raster.triangle
    right &= dr.gather(UInt32, here, pixel + 1, right) != here
    below &= dr.gather(UInt32, here, pixel + raster.width, below) != here
    keys = dr.empty(module.UInt64, 2 * pixels)
    result = PairList(dr.empty(UInt32, 2 * pixels), dr.zeros(UInt32, 1), dr.zeros(UInt32, 1))

    def add(pixel: Any, right: Any, below: Any) -> Any:
        slot = dr.scatter_inc(result.front, UInt32(0), right)
        dr.scatter(result.pairs, 2 * pixel, slot, right)
        slot = dr.scatter_inc(result.back, UInt32(0), below)
        dr.scatter(result.pairs, 2 * pixel + 1, 2 * pixels - 1 - slot, below)
        dr.scatter(keys, module.UInt64(0), 2 * pixel, right)
        dr.scatter(keys, module.UInt64(0), 2 * pixel + 1, below)
        return pixel

    dr.if_stmt((pixel, right, below), right | below, add, lambda pixel, right, below: pixel, mode="symbolic", label="differ")
    dr.eval(result.front, result.back, result.pairs, keys)
    return result, keys

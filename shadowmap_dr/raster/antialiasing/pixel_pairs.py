"""Pairs of neighbouring pixels, and lists of the few among them that need work.

Pair ``2 * p`` consists of pixel ``p`` and its right neighbour, pair ``2 * p + 1`` of ``p`` and the lower one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr

from ...jit.arrays import backend, scatter_inc
from ...jit.types import Bool, UInt32, UInt64
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

    pairs: UInt32
    front: UInt32
    back: UInt32
    touched: UInt32 | None = None

    def add_once(self, pair: UInt32, active: Bool) -> None:
        """Add pairs that have not been added before. To be traced only once for a list."""
        UInt32 = backend(self.pairs).UInt32
        if self.touched is None:
            raise ValueError("this list of pairs is complete; add pairs to an empty one")
        first = active & (scatter_inc(self.touched, pair, active) == 0)
        dr.scatter(self.pairs, pair, scatter_inc(self.front, UInt32(0), first), first)

    def for_each(self, visit: Callable[[UInt32, UInt32], None]) -> None:
        """Call ``visit(slot, pair)``, which writes somewhere, for all pairs in the list: full packets, whatever the image."""
        each_number(self.front + self.back, self.lanes, lambda slot: visit(slot, self.at(slot)))

    @property
    def lanes(self) -> int:
        """Number of lanes that deal with the list in turns."""
        return -(-dr.width(self.pairs) // _ROUNDS)

    def at(self, slot: UInt32) -> UInt32:
        """The pair in a slot."""
        index = dr.select(slot < self.front, slot, dr.width(self.pairs) - 1 - (slot - self.front))
        return dr.gather(type(slot), self.pairs, index)


def each_number(count: UInt32, lanes: int, visit: Callable[[UInt32], None]) -> None:
    """Call ``visit(number)``, which writes somewhere, for all ``UInt32`` below ``count``, at most about ``lanes`` at a time.

    Neighbouring lanes get neighbouring numbers, in packets, and each packet of lanes as many packets as any other: threads share
    the lanes out run by run, and all of them shall be busy even if there are few numbers.
    """
    module = backend(count)
    UInt64 = module.UInt64
    packets = -(-lanes // _PACKET)
    lane = dr.arange(module.UInt32, packets * _PACKET)
    packet = lane // _PACKET
    total = (count + (_PACKET - 1)) // _PACKET
    first, end = (module.UInt32(UInt64(p) * UInt64(total) // packets) * _PACKET for p in (packet, packet + 1))
    within = lane - packet * _PACKET

    def one(number: UInt32, end: UInt32) -> tuple[UInt32, UInt32]:
        visit(number)
        return number + _PACKET, end

    state = (first + within, dr.minimum(end, count))
    dr.while_loop(state, lambda *state: state[0] < state[1], one, mode="symbolic", label="pairs")


def empty_list(raster: RasterOutput) -> tuple[PairList, UInt64]:
    """A list to which pairs can be added, and for each pair a key (``UInt64``) of 0."""
    module = backend(raster.triangle)
    UInt32 = module.UInt32
    capacity = 2 * dr.width(raster.triangle)
    # Zeros that a kernel of all threads writes: faster than the one thread that fills an array with a constant.
    touched = dr.arange(UInt32, capacity) >> 31
    keys = module.UInt64(touched)
    dr.eval(touched, keys)
    return PairList(dr.empty(UInt32, capacity), dr.zeros(UInt32, 1), dr.zeros(UInt32, 1), touched), keys


def differing_pairs(raster: RasterOutput) -> tuple[PairList, UInt64]:
    """Pairs whose pixels see different triangles, and keys (``UInt64``), 0 for these pairs and undefined for others."""
    module = backend(raster.triangle)
    pixels = dr.width(raster.triangle)
    pixel = dr.arange(module.UInt32, pixels)
    row = pixel // raster.width
    column = pixel - row * raster.width
    if raster.batch > 1:
        row %= raster.height
    right, below = column + 1 < raster.width, row + 1 < raster.height
    here = raster.triangle
    right &= dr.gather(module.UInt32, here, pixel + 1, right) != here
    below &= dr.gather(module.UInt32, here, pixel + raster.width, below) != here
    keys = dr.empty(module.UInt64, 2 * pixels)
    result = PairList(dr.empty(module.UInt32, 2 * pixels), dr.zeros(module.UInt32, 1), dr.zeros(module.UInt32, 1))

    def add(pixel: UInt32, right: Bool, below: Bool) -> UInt32:
        slot = scatter_inc(result.front, module.UInt32(0), right)
        dr.scatter(result.pairs, 2 * pixel, slot, right)
        slot = scatter_inc(result.back, module.UInt32(0), below)
        dr.scatter(result.pairs, 2 * pixel + 1, 2 * pixels - 1 - slot, below)
        dr.scatter(keys, module.UInt64(0), 2 * pixel, right)
        dr.scatter(keys, module.UInt64(0), 2 * pixel + 1, below)
        return pixel

    dr.if_stmt((pixel, right, below), right | below, add, lambda pixel, *_: pixel, mode="symbolic", label="differ")
    dr.eval(result.front, result.back, result.pairs, keys)
    return result, keys

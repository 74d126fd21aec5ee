"""Pairs of neighbouring pixels, and lists of the few pairs that need work.

Pair ``2 * p`` consists of pixel ``p`` and its right neighbour, pair ``2 * p + 1`` of ``p`` and the lower one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr

from ...jit.arrays import backend, scatter_inc
from ...jit.kernel_inputs import double_input, uint_input
from ...jit.types import Bool, UInt32, UInt64
from ..types import RasterOutput, by_pixel
from .front_surfaces import FrontSurfaces

# Slots for each lane. Lanes take slots in rounds, so that short lists end after the first round.
_ROUNDS = 8
# Number of neighbouring lanes that work on neighbouring slots.
_PACKET = 16
# Lanes that a thread takes at once. Threads that count with one number wait for each other.
_BLOCK = 1 << 14
# Distance of numbers of which each is to have a cache line of its own.
_LINE = 16


@dataclass(frozen=True)
class PairList:
    """Some of the pairs, in no particular order.

    ``front[0]`` pairs fill ``pairs`` from the front, ``back[0]`` pairs from the back. Slots number both without a gap, from 0 on.
    The sizes of the arrays do not depend on the data. ``touched`` marks listed pairs, in lists to which pairs can be added.
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
        """Call ``visit(slot, pair)``, which scatters its results, for all pairs in the list, in full packets."""
        each_number(self.front + self.back, self.lanes, lambda slot: visit(slot, self.at(slot)))

    @property
    def lanes(self) -> int:
        """Number of lanes that share the list."""
        return -(-dr.width(self.pairs) // _ROUNDS)

    def at(self, slot: UInt32) -> UInt32:
        """The pair in a slot."""
        last = uint_input(backend(slot), "pairs", dr.width(self.pairs) - 1)
        index = dr.select(slot < self.front, slot, last - (slot - self.front))
        return dr.gather(type(slot), self.pairs, index)


def each_number(count: UInt32, lanes: int, visit: Callable[[UInt32], None]) -> None:
    """Call ``visit(number)``, which scatters its results, for all numbers below ``count``, in a loop over about ``lanes`` lanes.

    Neighbouring lanes get neighbouring numbers, in packets, and all packets of lanes get equally many. Threads take contiguous
    runs of lanes, so that all of them are busy even if there are few numbers.
    """
    module = backend(count)
    Float64 = module.Float64
    packets = -(-lanes // _PACKET)
    lane = dr.arange(module.UInt32, packets * _PACKET)
    packet = lane // _PACKET
    total = (count + (_PACKET - 1)) // _PACKET
    # Rounded to a whole number, for the last packet ends at the total.
    share = Float64(total) * double_input(module, "packets", 1 / packets)
    first, end = (module.UInt32(Float64(p) * share + 0.5) * _PACKET for p in (packet, packet + 1))
    within = lane - packet * _PACKET

    def one(number: UInt32, end: UInt32) -> tuple[UInt32, UInt32]:
        visit(number)
        return number + _PACKET, end

    state = (first + within, dr.minimum(end, count))
    dr.while_loop(state, lambda *state: state[0] < state[1], one, mode="symbolic", label="pairs")


def empty_list(raster: RasterOutput) -> tuple[PairList, UInt64]:
    """An empty list to which pairs can be added, and a key of 0 for each pair."""
    module = backend(raster.triangle)
    UInt32 = module.UInt32
    capacity = 2 * dr.width(raster.triangle)
    # A kernel of all threads writes these zeros; Dr.Jit fills constant arrays with a single thread.
    touched = dr.arange(UInt32, capacity) >> 31
    keys = module.UInt64(touched)
    dr.eval(touched, keys)
    return PairList(dr.empty(UInt32, capacity), dr.zeros(UInt32, 1), dr.zeros(UInt32, 1), touched), keys


def differing_pairs(raster: RasterOutput, front: FrontSurfaces | None = None) -> tuple[PairList, UInt64]:
    """Pairs whose pixels see different triangles or front surfaces, and keys: 0 for these pairs, undefined for others."""
    module = backend(raster.triangle)
    pixels = dr.width(raster.triangle)
    pixel = dr.arange(module.UInt32, pixels)
    _, row, column = by_pixel(pixel, raster.batch, raster.height, raster.width)
    width, height = uint_input(module, "width", raster.width), uint_input(module, "height", raster.height)
    right, below = column + 1 < width, row + 1 < height
    here = raster.triangle
    apart = [
        dr.gather(module.UInt32, here, other, active) != here for other, active in ((pixel + 1, right), (pixel + width, below))
    ]
    if front is not None:
        apart[0] |= front.differ(pixel, pixel + 1, right)
        apart[1] |= front.differ(pixel, pixel + width, below)
    right, below = right & apart[0], below & apart[1]
    keys = dr.empty(module.UInt64, 2 * pixels)
    blocks = -(-pixels // _BLOCK) if dr.backend_v(here) == dr.JitBackend.LLVM else 1
    found = dr.empty(module.UInt32, 2 * blocks * _BLOCK if blocks > 1 else 2 * pixels)
    counts = [dr.zeros(module.UInt32, blocks * _LINE if blocks > 1 else 1) for _ in range(2)]

    def add(pixel: UInt32, right: Bool, below: Bool) -> UInt32:
        first, last, counter = module.UInt32(0), uint_input(module, "pairs", 2 * pixels - 1), module.UInt32(0)
        if blocks > 1:
            block = pixel // _BLOCK
            first, last, counter = 2 * _BLOCK * block, 2 * _BLOCK * block + (2 * _BLOCK - 1), _LINE * block
        dr.scatter(found, 2 * pixel, first + scatter_inc(counts[0], counter, right), right)
        dr.scatter(found, 2 * pixel + 1, last - scatter_inc(counts[1], counter, below), below)
        dr.scatter(keys, module.UInt64(0), 2 * pixel, right)
        dr.scatter(keys, module.UInt64(0), 2 * pixel + 1, below)
        return pixel

    dr.if_stmt((pixel, right, below), right | below, add, lambda pixel, *_: pixel, mode="symbolic", label="differ")
    dr.eval(found, keys, counts)
    return (_joined(found, counts, pixels) if blocks > 1 else PairList(found, *counts)), keys


def _joined(found: UInt32, counts: list[UInt32], pixels: int) -> PairList:
    """One list of the pairs in ``found``, where each block has a part of its own, filled from both ends.

    A packet of lanes copies each part. ``counts``: how many there are at the front and at the back, the first number of each
    block's line.
    """
    module = backend(found)
    kind = module.UInt32
    result = PairList(dr.empty(kind, 2 * pixels), dr.empty(kind, 1), dr.empty(kind, 1))
    lane = dr.arange(kind, dr.width(counts[0]))
    block, within = lane // _LINE, lane % _LINE

    def before(other: UInt32, front: UInt32, back: UInt32) -> tuple[UInt32, UInt32, UInt32]:
        own = [dr.gather(kind, count, other * _LINE) for count in counts]
        return other + 1, front + own[0], back + own[1]

    state = kind(0), kind(0), kind(0)
    _, front, back = dr.while_loop(state, lambda other, *_: other < block, before, mode="symbolic", label="blocks before")
    own_front, own_back = (dr.gather(kind, count, block * _LINE) for count in counts)
    last = lane == uint_input(module, "blocks", dr.width(lane) - 1)
    dr.scatter(result.front, front + own_front, kind(0), last)
    dr.scatter(result.back, back + own_back, kind(0), last)

    def copy(
        number: UInt32, block: UInt32, front: UInt32, back: UInt32, own_front: UInt32, own_back: UInt32
    ) -> tuple[UInt32, ...]:
        ahead, behind = number < own_front, number - own_front
        start, end = 2 * _BLOCK * block, 2 * _BLOCK * block + (2 * _BLOCK - 1)
        pair = dr.gather(kind, found, dr.select(ahead, start + number, end - behind))
        place = dr.select(ahead, front + number, uint_input(module, "pairs", 2 * pixels - 1) - (back + behind))
        dr.scatter(result.pairs, pair, place)
        return number + _LINE, block, front, back, own_front, own_back

    lanes = within, block, front, back, own_front, own_back
    dr.while_loop(lanes, lambda number, *rest: number < rest[3] + rest[4], copy, mode="symbolic", label="join blocks")
    dr.eval(result.pairs, result.front, result.back)
    return result

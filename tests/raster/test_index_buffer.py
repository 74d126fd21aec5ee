"""Index buffers of copies: the host and the device put the same numbers in the same places."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr.raster import NO_VERTEX, index_buffer
from shadowmap_dr.raster.index_buffer import IndexBufferBuilder


@pytest.mark.parametrize("many", [1, 1 << 30])
def test_copies_and_single_numbers_as_numpy_puts_them(variant: str, many: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(index_buffer, "_MANY", many)
    random = np.random.default_rng(0)
    builder, expected = IndexBufferBuilder(mi.UInt32, 400), np.full(400, NO_VERTEX, np.uint32)
    start = 0
    for length, copies in ((7, 5), (1, 30), (40, 6)):
        numbers = random.integers(0, 1000, length)
        numbers[::4] = NO_VERTEX
        starts, shifts = start + (length + 1) * np.arange(copies), random.integers(0, 1000, copies)
        builder.repeat(numbers, starts, shifts)
        for begin, shift in zip(starts, shifts, strict=True):
            expected[begin : begin + length] = np.where(numbers == NO_VERTEX, NO_VERTEX, numbers + shift)
        start += (length + 1) * copies
    places = np.array([399, 7, 350])
    builder.put(places, np.array([3, 2, 1]))
    expected[places] = [3, 2, 1]
    np.testing.assert_array_equal(builder.build().numpy(), expected)

"""Index buffers of shapes and their copies, put together on the host or, where there are many numbers, on the device."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from ..jit.arrays import device_array
from ..jit.types import UInt32
from .types import NO_VERTEX

Numbers = npt.NDArray[np.integer[Any]]

# Numbers of copies from which a kernel takes less time than the host, most of which goes to new pages of memory.
_MANY = 1 << 18


class IndexBufferBuilder:
    """An index buffer under construction.

    Args:
        dtype: ``UInt32`` of the Dr.Jit backend in use.
        size: how many numbers there are.
    """

    def __init__(self, dtype: type[UInt32], size: int) -> None:
        self._dtype, self._size = dtype, size
        self._scattered: list[tuple[Numbers, Numbers]] = []
        self._copied: list[tuple[Numbers, Numbers, Numbers]] = []

    def put(self, places: Numbers, numbers: Numbers) -> None:
        """Numbers (N,) at ``places`` (N,)."""
        self._scattered.append((places, numbers))

    def repeat(self, numbers: Numbers, starts: Numbers, shifts: Numbers) -> None:
        """Numbers (N,) in one piece at each of ``starts`` (C,), greater by one of ``shifts`` (C,) there. ``NO_VERTEX`` stays."""
        self._copied.append((numbers.astype(np.uint32), starts, shifts.astype(np.uint32)))

    def build(self) -> UInt32:
        """The buffer, ``dtype``; ``NO_VERTEX`` where nothing was put."""
        if sum(len(numbers) * len(starts) for numbers, starts, _ in self._copied) >= _MANY:
            return self._on_device()
        return device_array(self._dtype, self._on_host())

    def _on_host(self) -> npt.NDArray[np.uint32]:
        buffer = np.full(self._size, NO_VERTEX, np.uint32)
        for numbers, starts, shifts in self._copied:
            none = numbers == NO_VERTEX
            for start, shift in zip(starts.tolist(), shifts, strict=True):
                part = buffer[start : start + len(numbers)]
                np.add(numbers, shift, out=part)
                part[none] = NO_VERTEX
        for places, numbers in self._scattered:
            buffer[places] = numbers
        return buffer

    def _on_device(self) -> UInt32:
        dtype = self._dtype
        buffer = dr.full(dtype, NO_VERTEX, self._size)
        dr.make_opaque(buffer)
        for numbers, starts, shifts in self._copied:
            own, begin, shift = (device_array(dtype, values) for values in (numbers, starts, shifts))
            lane = dr.arange(dtype, len(numbers) * len(starts))
            # Opaque, so that sizes are no part of the kernel.
            copy = lane // dr.opaque(dtype, len(numbers))
            within = lane - copy * len(own)
            number = dr.gather(dtype, own, within)
            number = dr.select(number == NO_VERTEX, number, number + dr.gather(dtype, shift, copy))
            dr.scatter(buffer, number, dr.gather(dtype, begin, copy) + within)
            dr.eval(buffer)
        for places, numbers in self._scattered:
            dr.scatter(buffer, device_array(dtype, numbers), device_array(dtype, places))
        dr.eval(buffer)
        return buffer

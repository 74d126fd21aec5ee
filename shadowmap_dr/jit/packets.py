"""Arrays that lie in a flat one: interleaved, in packets of two or four numbers, or one after the other.

Dr.Jit's own operations run a kernel for each number, or add adjoints to zeros number by number.
"""

from __future__ import annotations

from collections.abc import Iterator
from types import ModuleType
from typing import Any, cast

import drjit as dr

from .arrays import backend
from .kernel_inputs import SharingOp, uint_input
from .types import AnyArray, Float, UInt32


def packed(values: list[Float], parts: int = 1) -> Float:
    """A flat array with the entries of several arrays interleaved. Attached.

    ``parts``: number of equal parts of ``values``, of a multiple of four arrays each, that come after one another.
    """
    return dr.custom(_Packed, values, parts)


def apart(flat: Float, count: int, parts: int = 1) -> list[list[Float]]:
    """The arrays whose entries are interleaved in a flat one. Attached.

    Args:
        flat: ``parts`` arrays of ``count`` interleaved numbers for each entry, one after the other.

    Returns:
        For each part the ``count`` arrays.
    """
    found: list[Float] = dr.custom(_Apart, flat, count, parts)
    return [found[k * count : (k + 1) * count] for k in range(parts)]


def sections(values: list[Float], parts: int) -> list[list[Float]]:
    """Equal parts, which lie one after the other, of arrays of the same width. Attached.

    Returns:
        For each part a section of each array.
    """
    if parts == 1:
        return [values]
    found: list[Float] = dr.custom(_Sections, values, parts)
    return [found[k * len(values) : (k + 1) * len(values)] for k in range(parts)]


class _Sections(SharingOp):
    """:func:`sections`. The adjoint of Dr.Jit's own gather would add to zeros."""

    def eval(self, values: list[Float], parts: int) -> list[Float]:
        self._shape = dr.width(values[0]) // parts, parts
        return self._cut(values)

    def forward(self) -> None:
        self.set_grad_out(self._cut(cast("list[Float]", self.grad_in("values"))))

    def backward(self) -> None:
        gradients, (width, parts) = cast("list[Float]", self.grad_out()), self._shape
        count = len(gradients) // parts
        found = [dr.empty(type(gradients[k]), width * parts) for k in range(count)]
        for part, lane in enumerate(self._lanes(gradients[0])):
            for k in range(count):
                dr.scatter(found[k], gradients[part * count + k], lane, mode=dr.ReduceMode.Permute)
            # One part after the other: caches do not follow the arrays of all parts at once.
            dr.eval(found)
        self.set_grad_in("values", found)

    def name(self) -> str:
        return "sections"

    def _cut(self, values: list[Float]) -> list[Float]:
        lanes = self._lanes(values[0])
        return [dr.gather(type(value), value, lane) for lane in lanes for value in values]

    def _lanes(self, array: Float) -> list[UInt32]:
        """Lanes of each part."""
        (width, parts), module = self._shape, backend(array)
        lane = dr.arange(module.UInt32, width)
        return [lane + uint_input(module, "first lane", part * width) if part else lane for part in range(parts)]


class _Apart(SharingOp):
    """:func:`apart`."""

    def eval(self, flat: Float, count: int, parts: int) -> list[Float]:
        self._shape = dr.width(flat), count, parts
        return _read(flat, count, parts)

    def forward(self) -> None:
        self.set_grad_out(_read(cast("Float", self.grad_in("flat")), *self._shape[1:]))

    def backward(self) -> None:
        self.set_grad_in("flat", _written(cast("list[Float]", self.grad_out()), *self._shape))

    def name(self) -> str:
        return "apart"


class _Packed(SharingOp):
    """:func:`packed`."""

    def eval(self, values: list[Float], parts: int) -> Float:
        self._shape = max(dr.width(value) for value in values) * len(values), len(values) // parts, parts
        return _written(values, *self._shape)

    def forward(self) -> None:
        self.set_grad_out(_written(cast("list[Float]", self.grad_in("values")), *self._shape))

    def backward(self) -> None:
        self.set_grad_in("values", _read(cast("Float", self.grad_out()), *self._shape[1:]))

    def name(self) -> str:
        return "packed"


def _read(flat: Float, count: int, parts: int) -> list[Float]:
    """The arrays of all parts."""
    module, size = backend(flat), _size(count)
    packets = _packets(module, dr.width(flat), count, parts)
    found: list[Any] = [dr.gather(_kind(module, size), flat, packet) for packet in packets]  # Any: packets of any size
    return found if size == 1 else [value for values in found for value in values]


def _written(values: list[Float], width: int, count: int, parts: int) -> Float:
    """A flat array of a width, with the arrays of all parts."""
    module, size = backend(values[0]), _size(count)
    result = dr.empty(module.Float, width)
    for k, packet in enumerate(_packets(module, width, count, parts)):
        numbers = values[k * size : (k + 1) * size]
        # Each number is written once, which Dr.Jit has to know: else it writes each packet in a kernel of its own.
        dr.scatter(result, numbers[0] if size == 1 else _kind(module, size)(*numbers), packet, mode=dr.ReduceMode.Permute)
    return result


def _packets(module: ModuleType, width: int, count: int, parts: int) -> Iterator[UInt32]:
    """Indices of packets: for each part the first packet of all entries, then the second, ..."""
    entries, each = width // (count * parts), count // _size(count)
    entry = dr.arange(module.UInt32, entries)
    for part in range(parts):
        first = entry + uint_input(module, "first entry", part * entries) if part else entry
        for k in range(each):
            yield first * each + k


def _size(count: int) -> int:
    """Numbers of a packet."""
    return next(size for size in (4, 2, 1) if count % size == 0)


def _kind(module: ModuleType, size: int) -> type[AnyArray]:
    return {1: module.Float, 2: module.Array2f, 4: module.Array4f}[size]

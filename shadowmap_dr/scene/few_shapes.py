"""The vertices of a few shapes, one shape after the other, and which shapes have changed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import drjit as dr

from ..jit.types import AnyArray, Float
from .mitsuba_objects import Parameter
from .shapes.sources import ShapeSource
from .soup import Vertices

#: Positions, normals, texture coordinates and positions as Mitsuba holds them, of one shape.
Buffers4 = tuple[Float, Float, Float, Float]


@dataclass(frozen=True)
class _Reading:
    """Arrays of Mitsuba's that place a shape, detached.

    While they are held, their variables' numbers (``numbers``) are not used again: equal numbers mean the same arrays.
    """

    arrays: list[AnyArray]
    numbers: list[int]
    attached: bool

    @classmethod
    def of(cls, source: ShapeSource) -> _Reading:
        nodes = [node for node in (source.own_placement, source.instance) if node is not None]
        matrices = [Parameter(node, "to_world").now().matrix for node in nodes]
        arrays = [*source.read(), *(entry for matrix in matrices for line in matrix for entry in line)]
        held = [dr.detach(array) for array in arrays]
        return cls(held, [array.index for array in held], dr.grad_enabled(arrays))


class FewShapes:
    """The vertices of all shapes, made anew for shapes whose arrays have been given other values.

    Args:
        sources: of the shapes, in order.
        rigid: numbers of the shapes that are planar or faceted.
    """

    def __init__(self, sources: Sequence[ShapeSource], rigid: Sequence[int]) -> None:
        self._sources = sources
        self._at_first = {k: _Reading.of(sources[k]) for k in rigid}
        self._known: dict[int, tuple[_Reading, Buffers4]] = {}
        self._last: list[_Reading] = []
        self._all: Vertices | None = None

    def vertices(self, single: Callable[[int], Buffers4]) -> tuple[Vertices, list[int], list[int]]:
        """(all current vertices, attached; numbers of shapes with gradients; those of planar and faceted shapes that may have
        changed since the start, even if they have the same values).

        ``single``: returns the vertices of the shape with the given number, attached.
        """
        now = [_Reading.of(source) for source in self._sources]
        attached = [k for k, reading in enumerate(now) if reading.attached]
        moved = [k for k, then in self._at_first.items() if then.numbers != now[k].numbers]
        same = [reading.numbers for reading in now] == [reading.numbers for reading in self._last]
        if attached or not same or self._all is None:
            self._last = now
            made = [self._made(k, reading, single) for k, reading in enumerate(now)]
            found = Vertices(*(dr.concat(list(parts)) for parts in zip(*made, strict=True)))
            self._all = None if attached else found
            return found, attached, moved
        return self._all, attached, moved

    def _made(self, k: int, reading: _Reading, single: Callable[[int], Buffers4]) -> Buffers4:
        if reading.attached:
            return single(k)
        if k not in self._known or self._known[k][0].numbers != reading.numbers:
            positions, normals, texcoords, rest = (dr.detach(buffer) for buffer in single(k))  # gradients may be suspended only
            made = positions, normals, texcoords, rest
            dr.eval(made)
            self._known[k] = reading, made
        return self._known[k][1]

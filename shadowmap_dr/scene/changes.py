"""Changes of Mitsuba's objects: parameters with new values, shapes that a transformation mirrors."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..jit.types import AnyArray, Matrix4f
from .mitsuba_objects import Parameter
from .transforms import is_transform


def fingerprint(value: Any) -> object:  # Any: parameters have values of all kinds
    """Key that changes when a parameter is given another value: the keys of two reads are equal only if it was not.

    Arrays count by identity, not by contents. The key keeps them alive, so that their variables' numbers are not used again.
    """
    if dr.is_array_v(value):
        return tuple(_Same(leaf) for leaf in leaves(dr.detach(value)))
    if not is_transform(value):
        return repr(value)
    matrix = value.matrix
    return fingerprint(matrix) if dr.is_jit_v(matrix) else matrix.numpy().tobytes()


class _Same:
    """An array that is equal to itself alone."""

    def __init__(self, array: AnyArray) -> None:
        self.array = array

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.array.index == other.array.index

    __hash__ = None  # type: ignore[assignment]


def leaves(array: AnyArray) -> list[AnyArray]:
    """The flat arrays of a nested array or tensor, in a fixed order."""
    if dr.is_tensor_v(array):
        return [array.array]
    found = [array]
    for _ in range(dr.depth_v(array) - 1):
        found = [part for whole in found for part in whole]
    return found


class ParameterWatch:
    """Watch over parameters of Mitsuba's objects: tells if any has been given another value.

    Args:
        nodes: the objects. They are kept alive.
        chosen: predicate of an object and the name of one of its parameters; True for parameters to watch.
    """

    def __init__(self, nodes: Iterable[mi.Object], chosen: Callable[[mi.Object, str], bool]) -> None:
        tables = [(node, mi.traverse(node)) for node in {id(node): node for node in nodes}.values()]
        self._held = [(table, key) for node, table in tables for key in table.keys() if chosen(node, key)]
        self._then = self._now()

    def same(self) -> bool:
        """True if no parameter has a new value since the last call, or since the start."""
        then, self._then = self._then, self._now()
        return self._then == then

    def _now(self) -> list[object]:
        return [fingerprint(table[key]) for table, key in self._held]


class MirrorWatch:
    """Watch over which shapes and instances are mirrored; read back only where a transformation has been given another value."""

    def __init__(self, shapes: Sequence[mi.Shape]) -> None:
        self._transformations = [Parameter(shape, "to_world") for shape in dict.fromkeys(shapes)]
        self._matrices, self._numbers = self._read()
        # Read back when a matrix first changes: most scenes never do. The matrices held here stay as they were.
        self._mirrored: np.ndarray | None = None

    def same(self) -> bool:
        """True if the same shapes are mirrored as at the start."""
        matrices, numbers = self._read()
        # Equal numbers mean the same matrices: those held here keep their variables' numbers from being used again.
        if numbers == self._numbers:
            return True
        if self._mirrored is None:
            self._mirrored = _negative(self._matrices)
        other = [k for k, pair in enumerate(zip(numbers, self._numbers, strict=True)) if pair[0] != pair[1]]
        same = bool((_negative([matrices[k] for k in other]) == self._mirrored[other]).all())
        if same:
            self._matrices, self._numbers = matrices, numbers
        return same

    def _read(self) -> tuple[list[Matrix4f], list[list[int]]]:
        matrices = [dr.detach(transformation.now().matrix) for transformation in self._transformations]
        return matrices, [[entry.index for row in matrix for entry in row] for matrix in matrices]


def _negative(matrices: Sequence[Matrix4f]) -> np.ndarray:
    """True where the determinant of a 4 x 4 matrix without perspective is negative (bool, one for each)."""
    return np.linalg.det(read_back(matrices)[:, :, :3]) < 0 if len(matrices) else np.zeros(0, bool)


def read_back(matrices: Sequence[Matrix4f]) -> np.ndarray:
    """The first three rows of 4 x 4 matrices of single numbers, float64 (N, 3, 4)."""
    dr.eval(list(matrices))
    # Entry by entry, since that takes no kernel: most are constants.
    return np.array([[[matrix[i, j][0] for j in range(4)] for i in range(3)] for matrix in matrices], np.float64)

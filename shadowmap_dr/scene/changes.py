"""Changes of Mitsuba's objects: parameters that have been given other values, shapes that are mirrored."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .mitsuba_objects import Parameter


def fingerprint(value: Any) -> Any:
    """Something that is equal to that of another value only if a parameter has not been given another one in between.

    Of arrays it tells which they are, not what is in them, and keeps them alive, so that no others can be taken for them.
    """
    if dr.is_array_v(value):
        return tuple(_Same(leaf) for leaf in leaves(dr.detach(value)))
    matrix = getattr(value, "matrix", None)
    if matrix is None:
        return repr(value)
    return fingerprint(matrix) if dr.is_jit_v(matrix) else np.array(matrix).tobytes()


class _Same:
    """An array that is equal to itself alone."""

    def __init__(self, array: Any) -> None:
        self.array = array

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.array.index == other.array.index

    __hash__ = None  # type: ignore[assignment]


def leaves(array: Any) -> list[Any]:
    """The flat arrays of a nested array or tensor, in a fixed order."""
    if dr.is_tensor_v(array):
        return [array.array]
    found = [array]
    for _ in range(dr.depth_v(array) - 1):
        found = [part for whole in found for part in whole]
    return found


class ParameterWatch:
    """Parameters of Mitsuba's objects, read again and again to see whether any has been given another value.

    Args:
        nodes: the objects. They are kept alive.
        chosen: (object, name of a parameter of its) -> whether it counts.
    """

    def __init__(self, nodes: Iterable[Any], chosen: Callable[[Any, str], bool]) -> None:
        tables = [(node, mi.traverse(node)) for node in {id(node): node for node in nodes}.values()]
        self._held = [(table, key) for node, table in tables for key in table.keys() if chosen(node, key)]
        self._then = self._now()

    def same(self) -> bool:
        """True if all are as when this was last asked, or at the start."""
        then, self._then = self._then, self._now()
        return self._then == then

    def _now(self) -> list[Any]:
        return [fingerprint(table[key]) for table, key in self._held]


class MirrorWatch:
    """Watch over which shapes and instances are mirrored; read back only where a transformation has been given another value."""

    def __init__(self, shapes: Sequence[Any]) -> None:
        self._transformations = [Parameter(shape, "to_world") for shape in dict.fromkeys(shapes)]
        self._matrices, self._numbers = self._read()
        # Read back when it is first asked for: most scenes never change, and the matrices that are held do not.
        self._mirrored: np.ndarray | None = None

    def same(self) -> bool:
        """True if the same ones are mirrored as at the start."""
        matrices, numbers = self._read()
        # Those that are held cannot be taken for others: their variables' numbers are not used again.
        if numbers == self._numbers:
            return True
        if self._mirrored is None:
            self._mirrored = _negative(self._matrices)
        other = [k for k, pair in enumerate(zip(numbers, self._numbers, strict=True)) if pair[0] != pair[1]]
        same = bool((_negative([matrices[k] for k in other]) == self._mirrored[other]).all())
        if same:
            self._matrices, self._numbers = matrices, numbers
        return same

    def _read(self) -> tuple[list[Any], list[list[int]]]:
        matrices = [dr.detach(transformation.now().matrix) for transformation in self._transformations]
        return matrices, [[entry.index for row in matrix for entry in row] for matrix in matrices]


def _negative(matrices: Sequence[Any]) -> np.ndarray:
    """True if the determinants of 4 x 4 matrices without perspective are negative (bool, one for each)."""
    return np.linalg.det(read_back(matrices)[:, :, :3]) < 0 if len(matrices) else np.zeros(0, bool)


def read_back(matrices: Sequence[Any]) -> np.ndarray:
    """The first three rows of 4 x 4 matrices of single numbers, float64 (N, 3, 4)."""
    dr.eval(list(matrices))
    # Entry by entry, since that takes no kernel: most are constants.
    return np.array([[[matrix[i, j][0] for j in range(4)] for i in range(3)] for matrix in matrices], np.float64)

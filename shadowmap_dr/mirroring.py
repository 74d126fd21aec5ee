"""Transformations that mirror shapes, which turns their triangles' winding over."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import numpy as np

from .traversal import Parameter


def mirrored(shapes: Sequence[Any]) -> np.ndarray:
    """Whether the ``to_world`` of shapes and instances have a negative determinant (bool, one for each). Read back to the host.

    False where there is None in the place of a shape.
    """
    asked = [k for k, shape in enumerate(shapes) if shape is not None]
    found = np.zeros(len(shapes), bool)
    if asked:
        found[asked] = _negative([Parameter(shapes[k], "to_world").now().matrix for k in asked])
    return found


class MirrorWatch:
    """Which of some shapes and instances are mirrored; read back only where a transformation has been given another value."""

    def __init__(self, shapes: Sequence[Any]) -> None:
        self._transformations = [Parameter(shape, "to_world") for shape in dict.fromkeys(shapes)]
        self._matrices, self._numbers = self._read()
        # Read back when it is first asked for: most scenes never change, and the matrices that are held do not.
        self._mirrored: np.ndarray | None = None

    def same(self) -> bool:
        """Whether the same ones are mirrored as at the start."""
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
    """Whether the determinants of 4 x 4 matrices without perspective are negative (bool, one for each)."""
    return np.linalg.det(read_back(matrices)[:, :, :3]) < 0 if len(matrices) else np.zeros(0, bool)


def read_back(matrices: Sequence[Any]) -> np.ndarray:
    """The first three rows of 4 x 4 matrices of single numbers, float64 (N, 3, 4)."""
    dr.eval(list(matrices))
    # Entry by entry, since that takes no kernel: most are constants.
    return np.array([[[matrix[i, j][0] for j in range(4)] for i in range(3)] for matrix in matrices], np.float64)

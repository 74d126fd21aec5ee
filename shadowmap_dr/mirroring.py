"""Transformations that mirror shapes, which turns their triangles' winding over."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .traversal import Watch, parameters


def mirrors(shape: Any) -> bool:
    """Whether the ``to_world`` of a shape or instance has a negative determinant. Read back to the host."""
    matrix = np.array(parameters(shape)["to_world"].matrix, np.float64).reshape(4, 4)
    return bool(np.linalg.det(matrix[:3, :3]) < 0)


class MirrorWatch:
    """Which of some shapes and instances are mirrored; read back only where a transformation has been given another value."""

    def __init__(self, shapes: Sequence[Any]) -> None:
        self._shapes = tuple(dict.fromkeys(shapes))
        self._transformations = Watch(self._shapes, lambda _, key: key == "to_world")
        self._mirrored = self._now()

    def same(self) -> bool:
        """Whether the same ones are mirrored as at the start."""
        return self._transformations.same() or self._now() == self._mirrored

    def _now(self) -> list[bool]:
        return [mirrors(shape) for shape in self._shapes]

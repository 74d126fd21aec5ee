"""Checks of arrays and numbers that users give to Python functions. Every error is one line that names the value."""

from __future__ import annotations

import math
from numbers import Integral, Real
from typing import Any

import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError


def real_array(name: str, values: npt.ArrayLike, kind: type[Any] = np.float32) -> npt.NDArray[Any]:
    """A copy of an array of real numbers (or booleans), of the type ``kind``. Raises ShadowmapError for anything else.

    Numbers beyond the range of ``kind`` become infinite.
    """
    array = _array(name, values)
    if array.dtype.kind not in "fiub":
        raise ShadowmapError(f"{name}: {_shown(values, array)}, but must be an array of real numbers.")
    with np.errstate(over="ignore"):
        return array.astype(kind)


def index_array(name: str, values: npt.ArrayLike, count: int) -> npt.NDArray[np.uint32]:
    """A copy of an array of integers from 0 to ``count`` - 1. Raises ShadowmapError for anything else."""
    array = _array(name, values)
    if array.dtype.kind not in "iu":
        raise ShadowmapError(f"{name}: {_shown(values, array)}, but must be an array of integers.")
    if array.size and not (0 <= int(array.min()) and int(array.max()) < count):
        raise ShadowmapError(
            f"{name}: indices from {array.min()} to {array.max()}, but there are {count} vertices, counted from 0."
        )
    return array.astype(np.uint32)


def is_real(value: object) -> bool:
    """True for a finite number that is no boolean."""
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)


def is_whole(value: object) -> bool:
    """True for an integer that is no boolean."""
    return isinstance(value, Integral) and not isinstance(value, bool)


def _array(name: str, values: npt.ArrayLike) -> npt.NDArray[Any]:
    try:
        return np.asarray(values)
    except (ValueError, TypeError, RuntimeError) as error:  # of lists of different lengths, and of other libraries' arrays
        raise ShadowmapError(f"{name}: {type(values).__name__}, which is no array of numbers.") from error


def _shown(values: object, array: npt.NDArray[Any]) -> str:
    return f"an array of {array.dtype}" if isinstance(values, np.ndarray) else type(values).__name__

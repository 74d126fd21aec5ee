"""Arrays of NumPy's that begin anywhere in memory."""

from __future__ import annotations

import numpy as np


def unaligned(values: np.ndarray, offset: int = 1) -> np.ndarray:
    """The same numbers so many numbers behind an address that is a multiple of 64 bytes."""
    size = values.dtype.itemsize
    buffer = np.zeros(values.size + 64 // size + offset, values.dtype)
    begin = -buffer.ctypes.data % 64 // size + offset
    result = buffer[begin : begin + values.size].reshape(values.shape)
    result[...] = values
    return result

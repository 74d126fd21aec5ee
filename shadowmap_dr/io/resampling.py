"""Images of other sizes: each pixel is the average over the area that it covers, exactly, also where sides do not divide."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

# Numbers that are averaged at once: images may be large.
_AT_ONCE = 1 << 22


def area_average(
    rows: Callable[[slice], npt.NDArray[np.floating]], size: tuple[int, int], to: tuple[int, int]
) -> npt.NDArray[np.float32]:
    """Average an image over the areas of another image's pixels. Where these are smaller, they repeat what they lie in.

    Args:
        rows: returns rows of the image, (n, W, C), for a slice of them. It is called for a few at a time, from above, each once.
        size: (H, W) of the image.
        to: (h, w) of the result.

    Returns (h, w, C).
    """
    (height, width), (to_height, to_width) = size, to
    step = max(1, _AT_ONCE // (4 * max(width, to_width)))
    narrow = np.empty((0,), np.float32)
    for start in range(0, height, step):
        band = _averages(rows(slice(start, min(start + step, height))), to_width, axis=1)
        if not start:
            narrow = np.empty((height, *band.shape[1:]), np.float32)
        narrow[start : start + len(band)] = band
    if to_height == height:
        return narrow
    step = max(1, _AT_ONCE // (4 * max(height, to_height)))
    columns = [_averages(narrow[:, start : start + step], to_height, axis=0) for start in range(0, to_width, step)]
    return np.concatenate([column.astype(np.float32) for column in columns], axis=1)


def _averages(values: npt.NDArray[np.floating], count: int, axis: int) -> npt.NDArray[np.floating]:
    """Averages of values over ``count`` intervals of equal length along an axis."""
    length = values.shape[axis]
    if length == count:
        return values
    # In units of which values take `count` and results take `length`, all ends are whole numbers: lengths are exact.
    ends = np.union1d(np.arange(length + 1) * count, np.arange(count + 1) * length)
    lengths = np.diff(ends) / length
    shape = [1] * values.ndim
    shape[axis] = -1
    pieces = np.take(values, ends[:-1] // count, axis=axis).astype(np.float64) * lengths.reshape(shape)
    return np.add.reduceat(pieces, np.searchsorted(ends, np.arange(count) * length), axis=axis)

"""Fireflies of path tracers: single pixels of pictures that are far too bright."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

# Brightness of a firefly: at least so many times that of nearly all pixels, the share in per cent that these are, and at least so
# many times the median of its neighbours, so many pixels to each side. Reflections of lamps have bright neighbours.
_TIMES, _PERCENT, _OF_NEIGHBOURS, _REACH = 16.0, 99.0, 100.0, 2


def fireflies(pixels: npt.NDArray[Any]) -> npt.NDArray[np.bool_]:
    """True (H, W) for the fireflies of a linear picture (H, W, 3 or more): red, green and blue first.

    One of them would be most of a picture's brightness, of which errors are shares.
    """
    with np.errstate(invalid="ignore"):
        largest = np.where(np.isfinite(pixels[..., :3]).all(-1), pixels[..., :3].max(-1), 0).astype(np.float64)
    found = np.zeros(largest.shape, bool)
    usual = float(np.percentile(largest, _PERCENT)) if largest.size else 0.0
    if usual <= 0:
        return found
    for row, column in np.argwhere(largest > _TIMES * usual):
        near = largest[max(0, row - _REACH) : row + _REACH + 1, max(0, column - _REACH) : column + _REACH + 1]
        found[row, column] = largest[row, column] > _OF_NEIGHBOURS * np.median(near)
    return found

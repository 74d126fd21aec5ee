"""Silhouette images as targets: read, checked, mirrored to face right, and aligned with the shadow of the mean head."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...io.files import no_file
from ...io.pictures import read_picture

FloatArray = npt.NDArray[np.float32]

#: Least side of an image, and least difference of grey between head and background (0 to 1).
LEAST_SIDE, LEAST_CONTRAST = 16, 0.2
#: Share of the picture that a silhouette may cover.
LEAST_SHARE, MOST_SHARE = 0.02, 0.95
# The coarse search: rows of its pictures, ratios of sizes and shifts (rows) that it tries.
_COARSE, _SIZES, _SHIFTS = 32, np.geomspace(0.6, 1.7, 14), np.arange(-5, 6)


@dataclass(frozen=True)
class Placement:
    """Placement of an image over the window: ``scale`` image pixels per pixel of the window, and the image point at the middle of
    the window (x to the right, y down, in image pixels). ``mirrored``: the image is mirrored first.
    """

    scale: float
    x: float
    y: float
    mirrored: bool


def read_silhouette(path: str | Path) -> FloatArray:
    """(H, W) visibility in 0..1 of an image file: 0 in the silhouette, 1 around it, in between at soft edges.

    The silhouette may be the darker or the brighter part: the upper corners are background, as are transparent pixels.

    Raises ShadowmapError for files that are no images, and for images that show no silhouette: empty, of one colour, too small,
    or covered by it completely.
    """
    grey = _grey(Path(path))
    if min(grey.shape) < LEAST_SIDE:
        raise ShadowmapError(f"{path} has {grey.shape[1]} x {grey.shape[0]} pixels: give at least {LEAST_SIDE} x {LEAST_SIDE}.")
    low, high = np.quantile(grey, 0.005), np.quantile(grey, 0.995)
    if high - low < LEAST_CONTRAST:
        low, high = grey.min(), grey.max()
    if high - low < LEAST_CONTRAST:
        raise ShadowmapError(f"{path} is of one colour (grey {low:.2f} to {high:.2f}): give an image of a silhouette.")
    values = np.clip((grey - low) / (high - low), 0, 1)
    if 0.5 * (values[0, 0] + values[0, -1]) < 0.5:
        values = 1 - values
    share = float(np.mean(values < 0.5))
    if not LEAST_SHARE <= share <= MOST_SHARE:
        raise ShadowmapError(f"the silhouette covers {share:.1%} of {path}: give an image that a head fills for the most part.")
    return values.astype(np.float32)


def place(silhouette: FloatArray, shadow: FloatArray) -> Placement:
    """Align a silhouette (any size) with a shadow (H, W) by the least squared difference; both mirror images are tried.

    A coarse search over sizes and positions is followed by a fine one. Beyond the image's border, its border pixels are repeated.
    """
    coarse = _shrunk(shadow, _COARSE)
    best, least = None, np.inf
    for mirrored in (False, True):
        image = silhouette[:, ::-1] if mirrored else silhouette
        blurred = _shrunk(image, min(_COARSE, image.shape[0]))
        factor = image.shape[0] / blurred.shape[0]
        (x0, y0), extent = _head(blurred)
        (u, v), head_extent = _head(coarse)
        for size in _SIZES:
            scale = extent / head_extent * size
            for dx, dy in product(_SHIFTS, _SHIFTS):
                x = x0 + (coarse.shape[1] / 2 - u + dx) * scale
                y = y0 + (coarse.shape[0] / 2 - v + dy) * scale
                candidate = Placement(scale, x, y, mirrored)
                error = _difference(blurred, coarse, candidate)
                if error < least:
                    # In pixels of the whole image, and of the whole window.
                    whole = scale * factor * coarse.shape[0] / shadow.shape[0]
                    best, least = Placement(whole, x * factor, y * factor, mirrored), error
    assert best is not None  # something is always less than infinity
    return _refined(silhouette, shadow, best)


def resample(silhouette: FloatArray, shape: tuple[int, int], placement: Placement) -> FloatArray:
    """(H, W) image of a placed silhouette in a window of that shape. Pixels are means over their areas."""
    image = silhouette[:, ::-1] if placement.mirrored else silhouette
    n = int(np.clip(np.ceil(placement.scale), 1, 8))  # samples along each side of a pixel
    fine = _sampled(image, (shape[0] * n, shape[1] * n), replace(placement, scale=placement.scale / n))
    return fine.reshape(shape[0], n, shape[1], n).mean((1, 3)).astype(np.float32)


def _grey(path: Path) -> npt.NDArray[np.floating[Any]]:
    """Grey values (H, W) in 0..1 of an image file, over white."""
    if not path.is_file():
        raise no_file("image", path)
    pixels = read_picture(path)
    alpha = pixels[..., 3]
    grey = pixels[..., :3].mean(2)
    if alpha.min() < 0.5:  # transparency draws the outline, unless the opaque part has two colours
        opaque = grey[alpha > 0.5]
        if not opaque.size or opaque.max() - opaque.min() < LEAST_CONTRAST:
            return 1 - alpha
    return grey * alpha + (1 - alpha)


def _head(image: FloatArray) -> tuple[tuple[float, float], float]:
    """Middle (x, y) and height of the dark part, in pixels."""
    dark = 1 - np.asarray(image, np.float64)
    rows = np.flatnonzero(dark.max(1) > 0.5)
    top = float(rows[0]) if len(rows) else 0.0
    weights = dark.sum(0)
    x = float((np.arange(dark.shape[1]) + 0.5) @ weights / max(weights.sum(), 1e-9))
    bottom = float(rows[-1] + 1) if len(rows) else float(dark.shape[0])
    return (x, 0.5 * (top + bottom)), bottom - top


def _shrunk(image: FloatArray, rows: int) -> FloatArray:
    """The picture with the given number of rows; its square pixels are means."""
    height, width = image.shape
    columns = max(1, round(width * rows / height))
    return resample(image, (rows, columns), Placement(height / rows, width / 2, height / 2, False))


def _sampled(image: FloatArray, shape: tuple[int, int], placement: Placement) -> FloatArray:
    """Bilinear look-up at the centres of a window's pixels; the border is replicated."""
    x = placement.x + (np.arange(shape[1]) + 0.5 - shape[1] / 2) * placement.scale - 0.5
    y = placement.y + (np.arange(shape[0]) + 0.5 - shape[0] / 2) * placement.scale - 0.5
    rows = _lines(image, y, 0)
    return _lines(rows, x, 1)


def _lines(image: npt.NDArray[Any], at: npt.NDArray[np.floating[Any]], axis: int) -> npt.NDArray[Any]:
    last = image.shape[axis] - 1
    at = np.clip(at, 0, last)
    first = np.minimum(at.astype(np.int64), max(last - 1, 0))
    share = (at - first)[:, None] if axis == 0 else at - first
    a, b = np.take(image, first, axis), np.take(image, np.minimum(first + 1, last), axis)
    return a + (b - a) * share


def _difference(image: FloatArray, shadow: FloatArray, placement: Placement) -> float:
    return float(np.mean(np.square(_sampled(image, shadow.shape, placement) - shadow)))


def _refined(silhouette: FloatArray, shadow: FloatArray, start: Placement) -> Placement:
    """Pattern search over size and position, with steps that shrink to a tenth of a pixel of the window."""
    image = silhouette[:, ::-1] if start.mirrored else silhouette
    best, least, step = start, _difference(image, shadow, start), 4.0
    height = shadow.shape[0]
    while step > 0.1:
        moved = False
        for name, sign in product(("x", "y", "scale"), (-1, 1)):
            change = sign * step * best.scale * (2 / height if name == "scale" else 1)
            candidate = replace(best, **{name: getattr(best, name) + change})
            if candidate.scale > 0 and (error := _difference(image, shadow, candidate)) < least:
                best, least, moved = candidate, error, True
        step = step if moved else 0.5 * step
    return best

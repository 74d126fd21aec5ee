"""Target images of shadows: figures from image files, drawings and text, placed in a view."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...io.files import no_file
from ...io.pictures import SUFFIXES as PICTURE_SUFFIXES
from ...io.pictures import read_picture, scaled_to_bytes
from .drawings import rasterized

__all__ = ["SUFFIXES", "figure_height", "figure_of", "filled", "fit", "otsu", "read_figure", "scaled_to_bytes", "text_figure"]

#: Suffixes that `read_figure` knows.
SUFFIXES = (*PICTURE_SUFFIXES, ".svg", ".svgz")

# Pixels with more coverage belong to the figure; smallest share of an image that a figure may cover.
_INSIDE, _LEAST_SHARE = 0.5, 1e-4
# Brightness falls into two classes if Otsu's threshold separates it at least so well.
_SEPARATED = 0.85

Array = npt.NDArray[np.float32]


def read_figure(path: str | os.PathLike[str]) -> Array:
    """Read the figure in an image file.

    If the image has transparent parts, its opaque part is the figure. Otherwise the figure differs in brightness from the image's
    border: dark on light or light on dark. Drawings keep their soft edges. Photographs and noisy images, whose brightness does
    not fall into two classes, are smoothed and cut at Otsu's threshold.

    Args:
        path: an image file, see `SUFFIXES`. Drawings (SVG) need the package resvg-py.

    Returns:
        float32 (H, W), coverage from 0 to 1, in the image's size and aspect ratio.

    Raises ShadowmapError if the file does not exist, cannot be read, or shows no figure.
    """
    path = Path(path)
    if not path.is_file():
        raise no_file("image", path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ShadowmapError(f"cannot read {path}: the suffix {path.suffix!r} is not one of {', '.join(SUFFIXES)}.")
    pixels = read_picture(path, rasterized(path) if suffix in (".svg", ".svgz") else None)
    try:
        return figure_of(pixels)
    except ShadowmapError as error:
        raise ShadowmapError(f"{path}: {error}") from None


def figure_of(pixels: npt.ArrayLike) -> Array:
    """The figure (H, W) in an image (H, W, 4) of 0..1: red, green, blue, and opacity. See `read_figure`."""
    image = np.asarray(pixels, np.float32)
    alpha = image[..., 3]
    if alpha.min() < 0.25 and alpha.max() > 0.75:
        figure = alpha
    else:
        grey = (image[..., :3] @ np.array([0.2126, 0.7152, 0.0722], np.float32)) * alpha + (1 - alpha)
        threshold, separation = otsu(grey)
        if separation < _SEPARATED:
            grey = _smoothed(grey)
            threshold, _ = otsu(grey)
        border = float(np.median(np.concatenate([grey[0], grey[-1], grey[:, 0], grey[:, -1]])))
        light = border > (threshold if separation < _SEPARATED else 0.5)
        extreme = float(grey.min() if light else grey.max())
        contrast = border - extreme
        if abs(contrast) <= 0.1:
            figure = np.zeros_like(grey)
        elif separation < _SEPARATED:
            figure = ((grey <= threshold) == light).astype(np.float32)
        else:
            figure = np.clip((border - grey) / contrast, 0, 1)
    if (figure > _INSIDE).mean() < _LEAST_SHARE:
        raise ShadowmapError("it shows no figure: draw something dark on a light ground, or on a transparent one.")
    return np.ascontiguousarray(figure, np.float32)


def otsu(grey: npt.ArrayLike) -> tuple[float, float]:
    """Threshold between two classes of values in 0..1, and how well it separates them: 1 for two values, 0.64 for normal noise.

    Nobuyuki Otsu, "A threshold selection method from gray-level histograms", IEEE Trans. Systems, Man, and Cybernetics, 1979:
    the threshold with the largest variance between the classes, and that variance as a share of all.
    """
    counts, edges = np.histogram(np.asarray(grey), 256, (0, 1))
    middles, shares = 0.5 * (edges[1:] + edges[:-1]), counts / max(counts.sum(), 1)
    below, mean = np.cumsum(shares), np.cumsum(shares * middles)
    variance = float(shares @ np.square(middles - mean[-1]))
    between = np.square(mean[-1] * below - mean) / np.maximum(below * (1 - below), 1e-12)
    best = np.flatnonzero(between >= between.max() - 1e-12)  # all thresholds of a gap are equally good
    threshold = 0.5 * (edges[best[0] + 1] + edges[best[-1] + 1])
    return float(threshold), float(between.max() / variance) if variance > 1e-12 else 0.0


def _smoothed(grey: Array) -> Array:
    """Medians over squares a fiftieth of the image wide: noise and texture vanish, outlines stay."""
    from PIL import Image, ImageFilter

    image = Image.fromarray((np.clip(grey, 0, 1) * 255).round().astype(np.uint8))
    times = max(1, max(image.size) // 512)
    size = 2 * (max(image.size) // times // 100) + 1
    small = image.reduce(times).filter(ImageFilter.MedianFilter(max(3, size)))
    return np.asarray(small.resize(image.size, Image.Resampling.BILINEAR), np.float32) / np.float32(255)


def text_figure(text: str) -> Array:
    """The figure (H, W) of bold letters, with a margin of one pixel. ShadowmapError for letters that the font lacks."""
    from matplotlib import font_manager
    from PIL import Image, ImageDraw, ImageFont

    if not text.strip() or len(text) > 40:
        raise ShadowmapError(f"a text of {len(text)} characters: give 1 to 40, not only blanks.")
    font = ImageFont.truetype(font_manager.findfont("DejaVu Sans:bold"), 400)
    known = font_manager.get_font(font.path).get_charmap()
    missing = [letter for letter in dict.fromkeys(text) if not letter.isspace() and ord(letter) not in known]
    if missing:
        raise ShadowmapError(f"the font {font.getname()[0]} has no {' '.join(missing)}: give an image of the text instead.")
    canvas = ImageDraw.Draw(Image.new("L", (1, 1)))
    left, top, right, bottom = (int(x) for x in canvas.multiline_textbbox((0, 0), text, font=font))
    image = Image.new("L", (right - left + 2, bottom - top + 2), 0)
    ImageDraw.Draw(image).multiline_text((1 - left, 1 - top), text, fill=255, font=font, align="center")
    return _cropped(np.asarray(image, np.float32) / np.float32(255))


def filled(figure: npt.ArrayLike) -> Array:
    """The figure (H, W) with its enclosed holes filled: the best that the shadow of a deformed sphere can match."""
    from PIL import Image, ImageDraw

    inside = np.asarray(figure, np.float32)
    mask = Image.fromarray(np.pad(inside > _INSIDE, 1).astype(np.uint8) * 255).copy()  # arrays are read-only images
    ImageDraw.floodfill(mask, (0, 0), 128)
    enclosed = np.asarray(mask)[1:-1, 1:-1] == 0
    # The soft edge of a hole belongs to it.
    for axis, shift in ((0, 1), (0, -1), (1, 1), (1, -1)):
        enclosed = enclosed | (np.roll(enclosed, shift, axis) & (inside < 1))
    return np.where(enclosed, np.float32(1), inside)


def fit(figure: npt.ArrayLike, seen: npt.NDArray[np.bool_], fill: float = 0.8, high: float | None = None) -> Array:
    """A target image: the figure, dark on a lit ground, as large as the visible part of the receiver allows.

    Args:
        figure: (H, W) coverage, any size and aspect ratio; its empty margin does not count.
        seen: (H, W) of the view, pixels that see the receiver.
        fill: size relative to the largest possible one, to leave a margin.
        high: height of the figure in the view, in pixels, instead of `fill`.

    Returns:
        float32 (H, W) of the view: visibility, 0 (dark) to 1 (lit), the figure centred in the visible part of the receiver.
    """
    shape = _cropped(np.asarray(figure, np.float32))
    row, column = (axis.mean() for axis in np.nonzero(seen))
    height, width = shape.shape
    if high is None:
        sizes = np.linspace(1, 0.02, 197) * min(seen.shape[0] / height, seen.shape[1] / width)
        scale = fill * next((s for s in sizes if _within(shape, seen, row, column, s)), sizes[-1])
    else:
        scale = high / (height - 2)  # the margin that softens its edges does not count
    return 1 - _placed(shape, seen.shape, row, column, scale)


def figure_height(figure: npt.ArrayLike, seen: npt.NDArray[np.bool_], fill: float = 0.8) -> float:
    """Height in pixels that `fit` gives a figure."""
    dark = (fit(figure, seen, fill) < _INSIDE).any(1)
    return float(np.count_nonzero(dark))


def _within(shape: Array, seen: npt.NDArray[np.bool_], row: float, column: float, scale: float) -> bool:
    half = 0.5 * scale * np.array(shape.shape)
    if not (half[0] <= min(row + 0.5, seen.shape[0] - row - 0.5) and half[1] <= min(column + 0.5, seen.shape[1] - column - 0.5)):
        return False
    return not (_placed(shape, seen.shape, row, column, scale) > _INSIDE)[~seen].any()


def _placed(shape: Array, size: tuple[int, ...], row: float, column: float, scale: float) -> Array:
    """Box-filtered coverage of a view's pixels by a figure, centred at (row, column) and scaled."""
    from PIL import Image

    # Pillow's transform does not filter; a large image with sharp pixels is reduced instead.
    fine = 4
    height, width = size
    inverse = 1 / (scale * fine)
    x0 = 0.5 * shape.shape[1] - inverse * fine * (column + 0.5)
    y0 = 0.5 * shape.shape[0] - inverse * fine * (row + 0.5)
    image = Image.fromarray(shape).transform(
        (width * fine, height * fine), Image.Transform.AFFINE, (inverse, 0, x0, 0, inverse, y0), Image.Resampling.BILINEAR
    )
    return np.asarray(image, np.float32).reshape(height, fine, width, fine).mean((1, 3))


def _cropped(figure: Array) -> Array:
    rows, columns = (np.flatnonzero((figure > _INSIDE).any(axis)) for axis in (1, 0))
    if not len(rows):
        raise ShadowmapError("a figure that covers nothing.")
    cut = figure[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return np.pad(cut, 1)  # margin for soft edges

"""Target images of shadows: figures from image files, drawings and text, placed in a view."""

from __future__ import annotations

import gzip
import io
import os
import re
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError

if TYPE_CHECKING:
    import PIL.Image

#: Suffixes that `read_figure` knows.
SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".gif", ".bmp", ".svg", ".svgz")

# Pixels along the longer side of rasterized drawings; largest number of pixels of an image.
_SIDE, _MOST_PIXELS = 1024, 64_000_000
# Largest aspect ratio of a drawing; syntax of its lengths, and their units in pixels.
_MOST_SIDES_DIFFER = 64
_LENGTH = re.compile(r"\+?([0-9.]+(?:[eE][-+]?[0-9]+)?)(|%|px|pt|pc|mm|cm|in|em|ex)")
_UNITS = {"": 1, "px": 1, "pt": 4 / 3, "pc": 16, "mm": 96 / 25.4, "cm": 960 / 25.4, "in": 96, "em": 12, "ex": 6}
# Pixels with more coverage belong to the figure; smallest share of an image that a figure may cover.
_INSIDE, _LEAST_SHARE = 0.5, 1e-4

Array = npt.NDArray[np.float32]


def scaled_to_bytes(image: PIL.Image.Image) -> PIL.Image.Image:
    """Convert a Pillow image to 8 bits a channel. Pillow itself would clip 16-bit grey images instead of scaling them."""
    from PIL import Image

    if not image.mode.startswith("I"):
        return image
    return Image.fromarray((np.asarray(image).astype(np.uint32).clip(0, 65535) >> 8).astype(np.uint8))


def read_figure(path: str | os.PathLike[str]) -> Array:
    """Read the figure in an image file.

    If the image has transparent parts, its opaque part is the figure. Otherwise the figure differs in brightness from the image's
    border: dark on light or light on dark.

    Args:
        path: an image file, see `SUFFIXES`. Drawings (SVG) need the package resvg-py.

    Returns:
        float32 (H, W), coverage from 0 to 1, in the image's size and aspect ratio.

    Raises ShadowmapError if the file does not exist, cannot be read, or shows no figure.
    """
    path = Path(path)
    if not path.is_file():
        raise ShadowmapError(f"no image {str(path)!r}: the file does not exist.")
    if path.suffix.lower() in (".svg", ".svgz"):
        data: Path | io.BytesIO = io.BytesIO(_rasterized(path))
    elif path.suffix.lower() in SUFFIXES:
        data = path
    else:
        raise ShadowmapError(f"cannot read {path}: the suffix {path.suffix!r} is not one of {', '.join(SUFFIXES)}.")
    from PIL import Image

    try:
        with Image.open(data) as image:
            if image.width * image.height > _MOST_PIXELS:
                raise ShadowmapError(f"cannot read {path}: {image.width} x {image.height} pixels are too many.")
            pixels = np.asarray(scaled_to_bytes(image).convert("RGBA"), np.float32) / 255
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise ShadowmapError(f"cannot read {path}: it is no image, or it is damaged.") from error
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
        border = float(np.median(np.concatenate([grey[0], grey[-1], grey[:, 0], grey[:, -1]])))
        extreme = float(grey.min() if border > 0.5 else grey.max())
        contrast = border - extreme
        figure = np.clip((border - grey) / contrast, 0, 1) if abs(contrast) > 0.1 else np.zeros_like(grey)
    if (figure > _INSIDE).mean() < _LEAST_SHARE:
        raise ShadowmapError("it shows no figure: draw something dark on a light ground, or on a transparent one.")
    return np.ascontiguousarray(figure, np.float32)


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


def _rasterized(path: Path) -> bytes:
    try:
        import resvg_py
    except ModuleNotFoundError as error:
        raise ShadowmapError(f"{path}: drawings need the package resvg-py: pip install 'shadowmap-dr[art]'.") from error
    try:
        width, height = _drawn_size(path)
        # Only one side is given to resvg: in a narrow drawing the other side could have millions of pixels.
        if max(width, height) > _MOST_SIDES_DIFFER * min(width, height):
            raise ShadowmapError(
                f"cannot read {path}: a drawing of {width:g} x {height:g} is too narrow; its sides may differ by "
                f"{_MOST_SIDES_DIFFER} times."
            )
        side: dict[str, Any] = {"width": _SIDE} if width >= height else {"height": _SIDE}
        return bytes(resvg_py.svg_to_bytes(svg_path=str(path), dpi=96, **side))
    except (ValueError, ElementTree.ParseError, OSError, EOFError, zlib.error) as error:
        raise ShadowmapError(f"cannot read {path}: it is no drawing, or it is damaged.") from error


def _drawn_size(path: Path) -> tuple[float, float]:
    """(width, height) of a drawing in pixels, at least 1. ValueError if the file holds no drawing."""
    with gzip.open(path) if path.suffix.lower() == ".svgz" else path.open("rb") as file:
        root = next((element for _, element in ElementTree.iterparse(file, ("start",))), None)
    if root is None or root.tag.rpartition("}")[2] != "svg":
        raise ValueError("no element svg")
    box = [float(number) for number in re.split(r"[\s,]+", root.get("viewBox", "").strip()) if number]
    box = box[2:] if len(box) == 4 else []
    given = [_length(root.get(name, ""), whole) for name, whole in zip(("width", "height"), box or (100.0, 100.0), strict=True)]
    if box:
        # If one length is missing, it follows from the other and the proportions of the box.
        scales = [side / whole for side, whole in zip(given, box, strict=True) if side is not None] or [1.0]
        sides = [scales[0] * whole if side is None else side for side, whole in zip(given, box, strict=True)]
    else:
        sides = [100.0 if side is None else side for side in given]
    if not (np.isfinite(sides).all() and min(sides) > 0):
        raise ValueError("no extent")
    return max(sides[0], 1.0), max(sides[1], 1.0)


def _length(text: str, whole: float) -> float | None:
    """A length of a drawing in pixels, at 96 to the inch; None if it is no length. ``whole``: 100 %, in pixels."""
    found = _LENGTH.fullmatch(text.strip())
    if found is None:
        return None
    return float(found[1]) * (whole / 100 if found[2] == "%" else _UNITS[found[2]])

"""The film of a fit: from coarse to fine, beside the target, with the difference of both."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..errors import ShadowmapError
from ..io.animations import Pixels, encode_animation
from ..io.files import atomic
from . import display
from .result import Image, Picture, relative_error

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw
    from PIL.ImageFont import FreeTypeFont

#: Most frames, most bytes, and most targets that are shown.
MOST_FRAMES, MOST_BYTES, MOST_TARGETS = 60, 2_000_000, 4
#: Duration of a frame and of the last one, in milliseconds.
FRAME_MS, LAST_MS = 120, 2000

_COLUMNS = ("target", "fit", "difference")
# Longer side of an image in pixels, WebP's quality, and most frames: the first are tried first, until the file is small enough.
_ATTEMPTS = ((256, 75, MOST_FRAMES), (256, 50, MOST_FRAMES), (208, 40, 40), (160, 30, 24), (112, 25, 16))
# Lengths in pixels: the space between images, the height of a line of text, the size of letters.
_GAP, _LINE, _LETTERS = 8, 32, 22
_BACKGROUND, _INK, _PALE = (24, 27, 33), (240, 240, 240), (186, 192, 202)


def write_film(pictures: Sequence[Picture], path: str | os.PathLike[str]) -> None:
    """Write the film, .webp or .gif. The last frame stays for two seconds; about `MOST_BYTES` at most.

    It begins with the start and ends with the fit. Of more than `MOST_TARGETS` pictures, the first are shown. Raises
    ShadowmapError if there is no picture or for another suffix, and OutputError if the file cannot be written.
    """
    data = encode_film(pictures, Path(path).suffix)
    with atomic(path) as temporary:
        temporary.write_bytes(data)


def encode_film(pictures: Sequence[Picture], suffix: str = ".webp") -> bytes:
    """The content of the film's file, as `write_film` writes it."""
    shown = [picture for picture in pictures if picture.target.size][:MOST_TARGETS]
    if not shown:
        raise ShadowmapError("there is no film: the result has no pictures.")
    data = b""
    for side, quality, most in _ATTEMPTS:
        data = encode_animation(_frames(shown, side, most), suffix, FRAME_MS, LAST_MS, quality)
        if len(data) <= MOST_BYTES:
            break
    return data


def still(pictures: Sequence[Picture]) -> Pixels:
    """The last frame, for readers who want no motion: (H, W, 3), sRGB."""
    return _frames([picture for picture in pictures if picture.target.size][:MOST_TARGETS], _ATTEMPTS[0][0], 1)[-1]


def _frames(pictures: Sequence[Picture], side: int, most: int) -> list[Pixels]:
    """Frames of one size, at most so many, always with the last."""
    strips = [_Strip(picture, side) for picture in pictures]
    count = max(len(strip.moments) for strip in strips)
    numbers = sorted(set(np.linspace(count - 1, 0, min(most, count)).round().astype(int).tolist()))
    return [_frame(strips, number / max(1, count - 1), side) for number in numbers]


class _Strip:
    """The row of a target in all frames: the target, the fit so far, and their difference with one scale for the whole film."""

    def __init__(self, picture: Picture, side: int) -> None:
        self.picture = picture
        self.moments: list[tuple[str, Image]] = [("start", picture.start), *picture.frames, ("fit", picture.fit)]
        height, width = picture.target.shape[:2]
        scale = side / max(height, width)
        self.size = max(1, round(height * scale)), max(1, round(width * scale))
        self.gain = display.gain(picture)
        self._target = display.resized(display.colours(picture.target, self.gain), *self.size)
        values = display.difference(picture.start, picture.target, picture.weight)
        self.end = display.limit(values, picture.weight)
        self._drawn: dict[int, tuple[str, list[Pixels]]] = {}

    def at(self, time: float) -> tuple[str, list[Pixels]]:
        """Caption and images at a time of 0 to 1."""
        number = round(time * (len(self.moments) - 1))
        if number not in self._drawn:
            self._drawn[number] = self._draw(*self.moments[number])
        return self._drawn[number]

    def _draw(self, text: str, image: Image) -> tuple[str, list[Pixels]]:
        height, width = image.shape[:2]
        target, weight = self.picture.target, self.picture.weight
        if (height, width) != target.shape[:2]:
            target = display.averaged(target, height, width)
            # Pixels that are half masked count half.
            weight = display.averaged(weight, height, width)
        values = display.difference(image, target, weight)
        caption = f"{text}: error {display.percent(relative_error(image, target, weight))}"
        shown = display.resized(display.colours(image, self.gain), *self.size)
        return caption, [self._target, shown, display.difference_colours(values, weight, self.end, self.size)]


def _frame(strips: Sequence[_Strip], time: float, side: int) -> Pixels:
    """A frame: a row of images for each target, with a caption below."""
    from PIL import Image as pillow
    from PIL import ImageDraw

    heights = [strip.size[0] + _LINE + _GAP for strip in strips]
    width = 3 * side + 4 * _GAP
    canvas = pillow.new("RGB", (width, _LINE + _GAP + sum(heights)), _BACKGROUND)
    draw = ImageDraw.Draw(canvas)
    for k, title in enumerate(_COLUMNS):
        limits = f", ± {display.percent(strips[0].end)}" if k == 2 and len(strips) == 1 and side >= 256 else ""
        draw.text((_GAP + k * (side + _GAP), _GAP), title + limits, fill=_PALE, font=_font())
    top = _LINE + _GAP
    for strip, height in zip(strips, heights, strict=True):
        caption, tiles = strip.at(time)
        for k, tile in enumerate(tiles):
            canvas.paste(pillow.fromarray(tile), (_GAP + k * (side + _GAP) + (side - tile.shape[1]) // 2, top))
        named = f"{strip.picture.name}, {caption}" if len(strips) > 1 and strip.picture.name else caption
        draw.text((_GAP, top + strip.size[0] + 3), _shortened(draw, named, width - 2 * _GAP), fill=_INK, font=_font())
        top += height
    return np.asarray(canvas)


def _shortened(draw: ImageDraw, text: str, width: int) -> str:
    """A text in one line, cut where it is too wide."""
    text = " ".join(text.split())
    while draw.textlength(text, font=_font()) > width and len(text) > 1:
        text = text[:-2].rstrip("…") + "…"
    return text


@cache
def _font() -> FreeTypeFont:
    """Matplotlib's own font: it is there on all systems."""
    import matplotlib
    from PIL import ImageFont

    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), _LETTERS)

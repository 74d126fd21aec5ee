"""Animated images, WebP and GIF, in an endless loop."""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError
from .files import atomic

SUFFIXES = (".webp", ".gif")
#: Duration of a frame in milliseconds.
FRAME_MS = 70
# Colours of a GIF's frame.
_COLOURS = 128

Pixels = npt.NDArray[np.uint8]


def write_animation(
    path: str | os.PathLike[str], pictures: Sequence[Pixels], frame_ms: int = FRAME_MS, last_ms: int | None = None
) -> None:
    """Write an animated image, .webp or .gif. See `encode_animation`."""
    data = encode_animation(pictures, Path(path).suffix, frame_ms, last_ms)
    with atomic(path) as temporary:
        temporary.write_bytes(data)


def encode_animation(
    pictures: Sequence[Pixels], suffix: str, frame_ms: int = FRAME_MS, last_ms: int | None = None, quality: int = 70
) -> bytes:
    """The content of an animated image.

    Args:
        pictures: frames (H, W, 3), sRGB, of one size; at least one.
        suffix: ".webp" or ".gif".
        frame_ms, last_ms: duration of a frame and of the last frame, in milliseconds; None: as the others.
        quality: of a WebP, 0 to 100.

    Raises ShadowmapError for another suffix.
    """
    from PIL import Image

    kind = suffix.lower()
    if kind not in SUFFIXES:
        raise ShadowmapError(f"no animation {suffix!r}: the suffix is not one of {', '.join(SUFFIXES)}.")
    images = [Image.fromarray(picture) for picture in pictures]
    options: dict[str, Any] = {"quality": quality, "method": 4} if kind == ".webp" else {"optimize": True}
    if kind == ".gif":
        images = [image.quantize(_COLOURS, dither=Image.Dither.NONE) for image in images]
    duration = [frame_ms] * (len(images) - 1) + [frame_ms if last_ms is None else last_ms]
    data = io.BytesIO()
    images[0].save(data, format=kind[1:].upper(), save_all=True, append_images=images[1:], duration=duration, loop=0, **options)
    return data.getvalue()

"""Reading of users' pictures, of all usual formats. Sizes are checked before anything is decoded."""

from __future__ import annotations

import io
import os
import re
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError
from .images import MOST_DECODED, MOST_PIXELS, check_size, read_exr, to_srgb

if TYPE_CHECKING:
    import PIL.Image

#: Usual suffixes of pictures that `read_picture` knows; Pillow's formats are told by their content.
SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".gif", ".bmp", ".tif", ".tiff", ".exr")
#: Pixels along the longer side of what is returned.
LONGER_SIDE = 4096

# Pillow's other formats need programs (EPS), or are no pictures.
_FORMATS = ("PNG", "JPEG", "WEBP", "GIF", "BMP", "TIFF", "PPM", "TGA")
# Pillow keeps pixels of several channels in four bytes.
_PIXEL_BYTES = {"1": 1, "L": 1, "P": 1, "I;16": 2, "I;16B": 2, "I;16L": 2}


def read_picture(path: str | os.PathLike[str], data: bytes | None = None) -> npt.NDArray[np.float32]:
    """Read a picture: float32 (H, W, 4) of 0..1, in sRGB and with straight alpha. Large ones are shrunk to `LONGER_SIDE`.

    Args:
        path: file, or name in messages.
        data: the file's content, if it is not that of ``path``.

    Raises ShadowmapError if it is too large, damaged, or no picture.
    """
    if data is None and not Path(path).is_file():
        raise ShadowmapError(f"no image {str(path)!r}: the file does not exist.")
    if data is None and Path(path).suffix.lower() == ".exr":
        return _linear_picture(path)
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow's, of sizes and of metadata
            with Image.open(path if data is None else io.BytesIO(data), formats=_FORMATS) as image:
                check_size(path, image.width, image.height, _PIXEL_BYTES.get(image.mode, 4))
                small = scaled_to_bytes(image).convert("RGBA")
    except ShadowmapError:
        raise
    except Image.DecompressionBombError as error:
        raise ShadowmapError(_bomb(path, str(error))) from error
    except Exception as error:  # damaged files make decoders raise whatever they like
        raise ShadowmapError(f"cannot read {path}: it is no image, or it is damaged.") from error
    # Shrunk as bytes, which are a quarter of the numbers below.
    times = -(-max(small.size) // LONGER_SIDE)
    if times > 1:
        small = small.convert("RGBa").reduce(times).convert("RGBA")  # premultiplied: transparent colours do not count
    return np.asarray(small, np.float32) / np.float32(255)


def scaled_to_bytes(image: PIL.Image.Image) -> PIL.Image.Image:
    """Convert a Pillow image to 8 bits a channel. Pillow itself would clip deeper grey images instead of scaling them."""
    from PIL import Image

    if image.mode == "F":  # linear, as all floating-point images
        grey = to_srgb(np.nan_to_num(np.asarray(image)))
        return Image.fromarray((grey * 255).round().astype(np.uint8))
    if not image.mode.startswith("I"):
        return image
    return Image.fromarray((np.asarray(image).astype(np.int64).clip(0, 65535) >> 8).astype(np.uint8))


def _linear_picture(path: str | os.PathLike[str]) -> npt.NDArray[np.float32]:
    channels, _ = read_exr(path)
    names = ("R", "G", "B") if "R" in channels else ("Y", "Y", "Y")
    if not all(name in channels for name in names):
        raise ShadowmapError(f"cannot read {path}: it has no colour channels, only {', '.join(channels)}.")
    planes = [np.nan_to_num(np.asarray(channels[name], np.float32)) for name in names]
    if any(plane.shape != planes[0].shape for plane in planes):
        raise ShadowmapError(f"cannot read {path}: its channels differ in size; give an image without subsampling.")
    alpha = np.clip(np.nan_to_num(np.asarray(channels.get("A", np.ones_like(planes[0])), np.float32)), 0, 1)
    # OpenEXR's colours are premultiplied.
    with np.errstate(over="ignore"):  # white
        colours = [to_srgb(plane / np.maximum(alpha, np.float32(1e-6))) for plane in planes]
    picture = np.stack([*colours, alpha], axis=-1)
    times = -(-max(alpha.shape) // LONGER_SIDE)
    return picture[::times, ::times] if times > 1 else picture


def _bomb(path: str | os.PathLike[str], message: str) -> str:
    """Message of an image so large that Pillow does not even tell its sides."""
    count = re.search(r"\d+", message)
    pixels = int(count[0]) if count else MOST_PIXELS
    return (
        f"cannot read {path}: {pixels} pixels, {4 * pixels / 1e6:.0f} MB decoded, are too many; at most {MOST_PIXELS} pixels "
        f"and {MOST_DECODED / 1e6:.0f} MB can be: make the image smaller."
    )

"""Reading of users' pictures, of all usual formats. Sizes are checked before anything is decoded."""

from __future__ import annotations

import io
import os
import re
import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError
from .files import no_file
from .images import MOST_DECODED, MOST_PIXELS, check_size, read_exr, to_srgb
from .resampling import area_average

if TYPE_CHECKING:
    import PIL.Image
    import PIL.ImageFile

#: Usual suffixes of pictures that `read_picture` knows; Pillow's formats are told by their content.
SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".gif", ".bmp", ".tif", ".tiff", ".exr")
#: Pixels along the longer side of what is returned.
LONGER_SIDE = 4096

# Pillow's other formats need programs (EPS), or are no pictures.
_FORMATS = ("PNG", "JPEG", "WEBP", "GIF", "BMP", "TIFF", "PPM", "TGA")
# Pillow keeps pixels of several channels in four bytes; numbers of one channel are repeated here.
_PIXEL_BYTES = {"1": 1, "L": 1, "P": 1, "I;16": 8, "I;16B": 8, "I;16L": 8, "I": 8, "F": 16}
# Layouts of 16-bit colours in files, in Pillow's words, with the order of their bytes.
_DEEP = re.compile(r"(RGB|RGBX|RGBA|RGBa|LA);16[BLN]")
_NATIVE = "L" if sys.byteorder == "little" else "B"
# Pixels that are converted at once.
_CONVERTED = 1 << 20
# Number of EXIF's tag.
_ORIENTATION = 0x0112


def read_picture(path: str | os.PathLike[str], data: bytes | None = None) -> npt.NDArray[np.float32]:
    """Read a picture: float32 (H, W, 4) of 0..1, in sRGB and with straight alpha. Large ones are shrunk to `LONGER_SIDE`.

    Args:
        path: file, or name in messages.
        data: the file's content, if it is not that of ``path``.

    Raises ShadowmapError if it is too large, damaged, or no picture.
    """
    pixels = read_pixels(path, data)
    height, width = pixels.shape[:2]
    times = -(-max(height, width) // LONGER_SIDE)
    if pixels.dtype == np.uint8:
        return _bytes_shrunk(pixels, times) / np.float32(255)
    if times > 1:
        size = -(-height // times), -(-width // times)
        premultiplied = area_average(lambda rows: _premultiplied(pixels[rows]), (height, width), size)
    else:
        premultiplied = _premultiplied(pixels)
    alpha = premultiplied[..., 3:]
    with np.errstate(over="ignore"):  # white
        colours = premultiplied[..., :3] / np.maximum(alpha, np.float32(1e-6))
    return np.concatenate([colours if pixels.dtype == np.uint16 else to_srgb(colours), alpha], axis=-1)


def read_pixels(path: str | os.PathLike[str], data: bytes | None = None) -> npt.NDArray[Any]:
    """Pixels of a picture in the precision of its file, (H, W, 4), of full size and upright (EXIF).

    Integers, of 8 or 16 bits: sRGB with straight alpha, up to the largest number. float32, of OpenEXR and of floating-point TIFF:
    linear, premultiplied by alpha, in any range; some may be infinite or not a number.

    Args:
        path: file, or name in messages.
        data: the file's content, if it is not that of ``path``.

    Raises ShadowmapError if it is too large, damaged, or no picture.
    """
    if data is None and not os.path.isfile(path):
        raise no_file("image", path)
    if data is None and Path(path).suffix.lower() == ".exr":
        return _exr_pixels(path)
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow's, of sizes and of metadata
            with Image.open(path if data is None else io.BytesIO(data), formats=_FORMATS) as image:
                deep = _raw_modes(image)
                check_size(path, image.width, image.height, 8 if deep else _PIXEL_BYTES.get(image.mode, 4))
                pixels: npt.NDArray[Any]
                if deep and image.format == "PNG":
                    pixels = _deep_png(Path(path).read_bytes() if data is None else data)
                elif deep:
                    pixels = _deep_tiff(path if data is None else io.BytesIO(data), *deep)
                else:
                    pixels = _shallow(image)
                image.load()  # after which formats that Pillow turns itself are upright
                return _upright(pixels, _orientation(image))
    except ShadowmapError:
        raise
    except Image.DecompressionBombError as error:
        raise ShadowmapError(_bomb(path, str(error))) from error
    except Exception as error:  # damaged files make decoders raise whatever they like
        raise ShadowmapError(f"cannot read {path}: it is no image, or it is damaged.") from error


def _shallow(image: PIL.Image.Image) -> npt.NDArray[Any]:
    """Pixels that Pillow decodes as they are."""
    if image.mode == "F":
        grey = np.asarray(image, np.float32)
        return np.stack([grey, grey, grey, np.ones_like(grey)], axis=-1)
    if image.mode.startswith("I"):
        deep = np.asarray(image).astype(np.int64).clip(0, 65535).astype(np.uint16)
        return np.stack([deep, deep, deep, np.full_like(deep, 65535)], axis=-1)
    image.load()
    pixels = np.empty((image.height, image.width, 4), np.uint8)
    step = max(1, _CONVERTED // image.width)
    for top in range(0, image.height, step):  # whole pictures would be there four times
        band = image.crop((0, top, image.width, min(top + step, image.height)))
        pixels[top : top + step] = np.asarray(band.convert("RGBA"))
    return pixels


def _raw_modes(image: PIL.ImageFile.ImageFile) -> tuple[str, str] | None:
    """Pillow's names of the layout of 16-bit colours in a file, and of the same with bytes swapped; None for other pictures.

    Pillow keeps 8 bits of such colours: the high bytes with the first name, the low ones with the second.
    """
    if not image.tile:
        return None
    options: Any = image.tile[0][3]  # Any: of several types in Pillow
    name = options if isinstance(options, str) else str(options[0] if options else "")
    found = _DEEP.fullmatch(name)
    if found is None and not (name == "I;16B" and "transparency" in image.info and image.format == "PNG"):
        return None
    if image.format not in ("PNG", "TIFF"):
        return None
    # Premultiplied colours would be divided by the alpha of these bytes: they are read as they are.
    layout, order = name[:-1].replace("RGBa", "RGBA"), name[-1].replace("N", _NATIVE)
    return layout + order, layout + ("L" if order == "B" else "B")


def _deep_png(data: bytes) -> npt.NDArray[np.uint16]:
    """Pixels of a PNG file of 16 bits a channel. Pillow would keep 8 of them, Mitsuba keeps all."""
    import mitsuba as mi

    stream = mi.MemoryStream()
    stream.write(data)
    stream.seek(0)
    values = np.array(mi.Bitmap(stream))
    if values.dtype != np.uint16:
        raise ValueError("no 16 bits")
    values = values.reshape(*values.shape[:2], -1)
    channels = [0, 0, 0, 1] if values.shape[2] < 3 else [0, 1, 2, 3]
    opaque = np.full_like(values[..., :1], 65535)
    return np.concatenate([values, opaque], axis=-1)[..., channels]


def _deep_tiff(file: str | os.PathLike[str] | io.BytesIO, high: str, low: str) -> npt.NDArray[np.uint16]:
    """Pixels of a TIFF file of 16 bits a channel, whose bytes Pillow reads one after the other."""
    from PIL import Image

    values: npt.NDArray[np.uint16] = np.zeros((), np.uint16)
    premultiplied = False
    for name, factor in ((high, 256), (low, 1)):
        with Image.open(file, formats=_FORMATS) as image:
            tiles: Any = image.tile  # Any: of several types in Pillow's versions
            premultiplied = tiles[0][3][0].startswith("RGBa")
            make = getattr(type(tiles[0]), "_make", tuple)
            image.tile = [make((tile[0], tile[1], tile[2], (name, *tile[3][1:]))) for tile in tiles]
            values = values + np.asarray(image).astype(np.uint16) * np.uint16(factor)
    if values.shape[2] == 3:
        return np.concatenate([values, np.full_like(values[..., :1], 65535)], axis=-1)
    if premultiplied:
        alpha = np.maximum(values[..., 3:].astype(np.float64), 1)
        values[..., :3] = np.rint(values[..., :3] / alpha * 65535).clip(0, 65535)
    return values


def _orientation(image: PIL.Image.Image) -> int:
    """The number of EXIF for the way in which a picture lies; 1 if there is none."""
    try:
        return int(image.getexif().get(_ORIENTATION, 1))
    except Exception:  # of many kinds, for damaged metadata: the picture is good all the same
        return 1


def _upright(pixels: npt.NDArray[Any], orientation: int) -> npt.NDArray[Any]:
    if orientation in (5, 6, 7, 8):
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return pixels


def _bytes_shrunk(pixels: npt.NDArray[Any], times: int) -> npt.NDArray[np.uint8]:
    """8-bit pixels, shrunk as such: they are a quarter of numbers in single precision."""
    if times <= 1:
        return pixels
    from PIL import Image

    # Premultiplied: transparent colours do not count.
    small = Image.fromarray(np.ascontiguousarray(pixels)).convert("RGBa").reduce(times).convert("RGBA")
    return np.asarray(small)


def _premultiplied(pixels: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """Finite colours, premultiplied, and alpha in 0..1, of pixels of 16 bits or in single precision."""
    if pixels.dtype == np.uint16:
        values = pixels / np.float32(65535)
        return np.concatenate([values[..., :3] * values[..., 3:], values[..., 3:]], axis=-1)
    values = np.nan_to_num(pixels)
    return np.concatenate([values[..., :3], np.clip(values[..., 3:], 0, 1)], axis=-1)


def scaled_to_bytes(image: PIL.Image.Image) -> PIL.Image.Image:
    """Convert a Pillow image to 8 bits a channel. Pillow itself would clip deeper grey images instead of scaling them."""
    from PIL import Image

    if image.mode == "F":  # linear, as all floating-point images
        grey = to_srgb(np.nan_to_num(np.asarray(image)))
        return Image.fromarray((grey * 255).round().astype(np.uint8))
    if not image.mode.startswith("I"):
        return image
    return Image.fromarray((np.asarray(image).astype(np.int64).clip(0, 65535) >> 8).astype(np.uint8))


def _exr_pixels(path: str | os.PathLike[str]) -> npt.NDArray[np.float32]:
    channels, _ = read_exr(path)
    names = ("R", "G", "B") if "R" in channels else ("Y", "Y", "Y")
    if not all(name in channels for name in names):
        raise ShadowmapError(f"cannot read {path}: it has no colour channels, only {', '.join(channels)}.")
    planes = [np.asarray(channels[name], np.float32) for name in names]
    planes.append(np.asarray(channels.get("A", np.ones_like(planes[0])), np.float32))
    if any(plane.shape != planes[0].shape for plane in planes):
        raise ShadowmapError(f"cannot read {path}: its channels differ in size; give an image without subsampling.")
    return np.stack(planes, axis=-1)  # OpenEXR's colours are premultiplied


def _bomb(path: str | os.PathLike[str], message: str) -> str:
    """Message of an image so large that Pillow does not even tell its sides."""
    count = re.search(r"\d+", message)
    pixels = int(count[0]) if count else MOST_PIXELS
    return (
        f"cannot read {path}: {pixels} pixels, {4 * pixels / 1e6:.0f} MB decoded, are too many; at most {MOST_PIXELS} pixels "
        f"and {MOST_DECODED / 1e6:.0f} MB can be: make the image smaller."
    )

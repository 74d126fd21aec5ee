"""Reading and writing of images."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import OutputError, ShadowmapError
from .files import SUFFIXES, atomic, no_file

Array = npt.NDArray[np.generic]

#: Most pixels of an image that is read, and most bytes of memory that its decoded pixels take.
MOST_PIXELS, MOST_DECODED = 64_000_000, 1_000_000_000


def write_exr(path: str | os.PathLike[str], channels: Mapping[str, Array], metadata: Mapping[str, str] | None = None) -> None:
    """Write a multi-channel OpenEXR file.

    Args:
        path: file to write; parent directories are created.
        channels: name -> array (H, W) of float16, float32 or uint32, top row first. Usual names: R, G, B, A, Y, depth.Z.
        metadata: strings to store in the header.

    Raises OutputError if the file cannot be written.
    """
    import OpenEXR

    header: dict[str, object] = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    header.update(metadata or {})
    arrays = {name: np.ascontiguousarray(array) for name, array in channels.items()}
    shapes = sorted({array.shape for array in arrays.values()})
    if len(shapes) != 1 or len(shapes[0]) != 2 or 0 in shapes[0]:
        raise ShadowmapError(f"cannot write {path}: channels of the shapes {shapes}; give arrays (H, W) of one size, not empty.")
    for name, array in arrays.items():
        if array.dtype not in (np.float16, np.float32, np.uint32):
            raise ShadowmapError(f"cannot write {path}: channel {name} is {array.dtype}; give float16, float32 or uint32.")
    with atomic(path) as temporary:
        try:
            with OpenEXR.File(header, arrays) as file:
                file.write(str(temporary))
        except RuntimeError as error:
            reason = str(error).replace("\n", " ").rstrip(".").rsplit(". ", 1)[-1]
            raise OutputError(f"cannot write {path}: {reason}.") from error


def read_exr(path: str | os.PathLike[str]) -> tuple[dict[str, Array], dict[str, str]]:
    """Channels (name -> (H, W) array) and the header's strings of an OpenEXR file. Raises ShadowmapError if it is unreadable."""
    import OpenEXR

    if not os.path.isfile(path):
        raise no_file("image", path)
    try:
        with OpenEXR.File(str(path), separate_channels=True, header_only=True) as file:
            for k in range(len(file.parts)):  # headers are empty after the block
                _check_header(path, file.header(k))
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
            metadata = {name: value for name, value in file.header().items() if isinstance(value, str)}
    except ShadowmapError:
        raise
    except Exception as error:  # the library raises errors of many kinds for damaged headers
        raise ShadowmapError(f"cannot read {path}: it is no OpenEXR file, or it is damaged.") from error
    return channels, metadata


def check_size(path: str | os.PathLike[str], width: int, height: int, pixel_bytes: int) -> None:
    """ShadowmapError, with numbers, if an image is too large to decode. ``pixel_bytes``: bytes of a decoded pixel."""
    decoded = width * height * pixel_bytes
    if width * height > MOST_PIXELS or decoded > MOST_DECODED:
        raise ShadowmapError(
            f"cannot read {path}: {width} x {height} pixels, {decoded / 1e6:.0f} MB decoded, are too many; at most "
            f"{MOST_PIXELS} pixels and {MOST_DECODED / 1e6:.0f} MB can be: make the image smaller."
        )


def _check_header(path: str | os.PathLike[str], header: Mapping[str, Any]) -> None:
    """Check what the header of an OpenEXR file announces."""
    low, high = (np.asarray(corner).astype(np.int64).tolist() for corner in header["dataWindow"])
    width, height = high[0] - low[0] + 1, high[1] - low[1] + 1
    pixel_bytes = 4 * max(1, len(header.get("channels", ())))
    check_size(path, width, height, pixel_bytes)
    if "tiles" in header:  # whole tiles are decoded, also beyond the image
        check_size(path, int(header["tiles"].xSize), int(header["tiles"].ySize), pixel_bytes)
    if "deep" in str(header.get("type", "")).lower():
        raise ShadowmapError(f"cannot read {path}: its pixels are deep; give a flat image.")


def write_png(path: str | os.PathLike[str], image: Array) -> None:
    """Write an image as an 8-bit sRGB PNG. Values outside [0, 1] are clipped.

    Args:
        path: file to write; parent directories are created.
        image: linear (H, W), (H, W, 1), (H, W, 3) or, with alpha, (H, W, 4), top row first.
    """
    from PIL import Image

    pixels = _single(image)
    if pixels.ndim == 3 and pixels.shape[2] == 1:
        pixels = pixels[..., 0]
    if pixels.ndim not in (2, 3) or not pixels.size or (pixels.ndim == 3 and pixels.shape[2] not in (3, 4)):
        raise ShadowmapError(f"an image of shape {np.shape(image)} is no PNG: give (H, W), (H, W, 1), (H, W, 3 or 4), not empty.")
    encoded = to_srgb(pixels)
    if pixels.ndim == 3 and pixels.shape[2] == 4:
        encoded[..., 3] = np.clip(pixels[..., 3], 0, 1)
    with atomic(path) as temporary:
        Image.fromarray(np.round(np.nan_to_num(encoded) * 255).astype(np.uint8)).save(temporary, format="PNG")


def write_image(path: str | os.PathLike[str], image: Array, metadata: Mapping[str, str] | None = None) -> None:
    """Write a linear (H, W, C) image with 1, 3 or 4 channels as .exr or .png, by the suffix of ``path``."""
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".png":
        write_png(path, image)
    elif suffix == ".exr":
        pixels = _single(image)
        pixels = pixels[..., None] if pixels.ndim == 2 else pixels
        if pixels.ndim != 3 or not pixels.size:
            raise ShadowmapError(
                f"cannot write {path}: an image of shape {np.shape(image)}; give (H, W) or (H, W, C), not empty."
            )
        write_exr(path, {name: pixels[..., i] for i, name in enumerate(colour_channels(pixels.shape[2]))}, metadata)
    else:
        raise OutputError(f"cannot write {path}: the suffix {suffix!r} is not one of {', '.join(SUFFIXES)}.")


def read_image(path: str | os.PathLike[str]) -> npt.NDArray[np.float32]:
    """Colour channels of an OpenEXR file as a linear float32 (H, W, 1) or (H, W, 3) image."""
    channels, _ = read_exr(path)
    names = ("R", "G", "B") if "R" in channels else ("Y",)
    if not all(name in channels for name in names):
        raise ShadowmapError(f"cannot read {path}: it has no colour channels, only {', '.join(channels)}.")
    return np.stack([channels[name] for name in names], axis=-1).astype(np.float32)


def colour_channels(count: int) -> tuple[str, ...]:
    """OpenEXR channel names of an image with ``count`` colour channels (1 to 4)."""
    names = {1: ("Y",), 2: ("Y", "A"), 3: ("R", "G", "B"), 4: ("R", "G", "B", "A")}.get(count)
    if names is None:
        raise ShadowmapError(f"an image with {count} colour channels has no OpenEXR channel names: give 1 to 4.")
    return names


def _single(image: Array) -> npt.NDArray[np.float32]:
    """An image in single precision; numbers beyond its range become infinite."""
    with np.errstate(over="ignore"):
        return np.asarray(image, dtype=np.float32)


def to_linear(srgb: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Linear values of sRGB values in [0, 1] (IEC 61966-2-1)."""
    x = np.asarray(srgb, np.float64)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def to_srgb(linear: Array) -> npt.NDArray[np.float32]:
    """sRGB transfer curve (IEC 61966-2-1) of linear values, clipped to [0, 1]."""
    x = np.clip(_single(linear), 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(x, 1 / 2.4) - 0.055).astype(np.float32)

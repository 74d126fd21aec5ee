"""Pictures of all formats, sizes and kinds of pixels, most of them damaged, given to their readers."""

from __future__ import annotations

import gzip
import io
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.faces.silhouette import read_silhouette
from shadowmap_dr.interactive import exports
from shadowmap_dr.inverse.shadow_art.target_images import figure_of, fit, read_figure, text_figure
from shadowmap_dr.io import images
from shadowmap_dr.io.pictures import LONGER_SIDE, read_picture

from .outcome import check
from .values import NUMBERS, chance, mutated, mutated_text, pick

_MODES = ("1", "L", "LA", "P", "RGB", "RGBA", "I;16", "CMYK", "I", "F", "YCbCr")
# Mode of a Pillow image -> formats that hold it.
_FORMATS = {
    **{
        "1": ("PNG", "TIFF", "BMP"),
        "L": ("PNG", "JPEG", "TIFF", "GIF", "WEBP"),
        "LA": ("PNG", "TIFF"),
        "P": ("PNG", "GIF", "BMP"),
    },
    **{
        "RGB": ("PNG", "JPEG", "WEBP", "BMP", "TIFF", "PPM", "TGA"),
        "RGBA": ("PNG", "WEBP", "TIFF", "GIF"),
        "I;16": ("PNG", "TIFF"),
    },
    **{"CMYK": ("JPEG", "TIFF"), "I": ("TIFF",), "F": ("TIFF",), "YCbCr": ("JPEG", "TIFF")},
}
_SIDES = (1, 1, 2, 3, 16, 17, 40, 64, 300)


def run(rng: np.random.Generator, folder: Path) -> str:
    """Give a picture to its readers."""
    chosen = (*[_picture] * 7, _declared, _declared, *[_exr] * 4, _drawing, _figure, _text, _written)
    return pick(rng, chosen)(rng, folder)


def _pixels(rng: np.random.Generator) -> Any:
    """A dark disk on a light ground, noise, or one colour: (H, W, 4) of 0..1."""
    height, width = pick(rng, _SIDES), pick(rng, _SIDES)
    if chance(rng, 0.05):
        height, width = pick(rng, ((1, 5000), (5000, 1), (4097, 2)))
    y, x = np.mgrid[:height, :width] / max(height, width)
    kind = rng.integers(3)
    if kind == 0:
        grey = (np.hypot(x - x.mean(), y - y.mean()) > 0.3).astype(float)
    elif kind == 1:
        grey = rng.random((height, width))
    else:
        grey = np.full((height, width), rng.random())
    alpha = np.ones_like(grey) if chance(rng, 0.6) else rng.random((height, width)).round() if chance(rng, 0.5) else 1 - grey
    return np.stack([grey, grey**2, np.sqrt(grey), alpha], -1)


def _encoded(rng: np.random.Generator) -> tuple[str, bytes, Image.Image]:
    """Suffix, content and image of a file."""
    pixels, mode = _pixels(rng), pick(rng, _MODES)
    colours = Image.fromarray((pixels * 255).round().astype(np.uint8), "RGBA")
    if mode in ("I;16", "I", "F"):
        grey = pixels[..., 0] * (1 if mode == "F" else 65535)
        kinds: dict[str, Any] = {"I;16": np.uint16, "I": np.int32, "F": np.float32}
        image = Image.fromarray(grey.astype(kinds[mode]))
    elif mode in ("LA", "RGBA"):
        image = colours.convert(mode)
    else:
        image = colours.convert("RGB").convert(mode)
    form = pick(rng, _FORMATS[mode])
    buffer = io.BytesIO()
    image.save(buffer, format=form)
    return "." + form.lower(), buffer.getvalue(), image


def _picture(rng: np.random.Generator, folder: Path) -> str:
    suffix, data, image = _encoded(rng)
    sound = chance(rng, 0.2)
    data = data if sound else mutated(rng, data)
    return _read(
        rng, folder, suffix if chance(rng, 0.95) else pick(rng, (".exr", ".png", ".svg")), data, image.size if sound else None
    )


def _read(rng: np.random.Generator, folder: Path, suffix: str, data: bytes, size: tuple[int, int] | None) -> str:
    path = folder / f"picture{suffix}"
    path.write_bytes(data)
    reader = int(rng.integers(5))
    if reader == 0:
        return _checked_figure(read_figure(path))
    if reader == 1:
        seen = np.ones((24, 32), bool)
        target = exports.read_target(data, seen)
        return _in_range(target, (24, 32))
    if reader == 2:
        return _in_range(exports.read_shadow(data, (16, 16)), (16, 16))
    if reader == 3:
        return _in_range(np.asarray(read_silhouette(path), np.float32), None)
    pixels = read_picture(path)
    check(pixels.ndim == 3 and pixels.shape[2] == 4 and pixels.dtype == np.float32, f"a picture {pixels.dtype} {pixels.shape}")
    check(max(pixels.shape) <= LONGER_SIDE, f"a picture {pixels.shape}")
    if size is not None and max(size) <= LONGER_SIDE and suffix != ".exr":
        check(pixels.shape[:2] == size[::-1], f"{pixels.shape} of a picture {size}")
    return _in_range(pixels, None)


def _in_range(values: Any, shape: tuple[int, ...] | None) -> str:
    check(shape is None or values.shape == shape, f"shape {values.shape} instead of {shape}")
    check(values.size and np.isfinite(values).all(), "values are not finite, or there are none")
    check(values.min() >= -1e-5 and values.max() <= 1 + 1e-5, f"values from {values.min()} to {values.max()}")
    return f"{values.shape}, mean {values.mean():.3f}"


def _checked_figure(figure: Any) -> str:
    """A figure that fits into a view."""
    _in_range(figure, None)
    return _in_range(fit(figure, np.ones((24, 32), bool)), (24, 32))


def _declared(rng: np.random.Generator, folder: Path) -> str:
    """Small files whose headers declare other sizes."""
    width, height = (int(pick(rng, (0, 1, 7, 4096, 30_000, 2**16, 2**31 - 1, 2**32 - 1))) for _ in range(2))
    form = pick(rng, ("PNG", "GIF", "BMP", "TIFF", "EXR"))
    if form == "PNG":
        depth, colour = pick(rng, ((8, 2), (8, 6), (16, 0), (1, 0), (8, 3), (3, 9)))
        chunk = b"IHDR" + struct.pack(">2I5B", width, height, depth, colour, 0, 0, 0)
        body = b"IDAT" + zlib.compress(bytes(int(pick(rng, (10, 1000, 10**6)))))
        parts = [struct.pack(">I", len(c) - 4) + c + struct.pack(">I", zlib.crc32(c)) for c in (chunk, body, b"IEND")]
        data = b"\x89PNG\r\n\x1a\n" + b"".join(parts)
    elif form == "GIF":
        data = b"GIF89a" + struct.pack("<2H", width & 0xFFFF, height & 0xFFFF) + rng.bytes(50)
    elif form == "BMP":
        header = struct.pack(
            "<I2i2H6I", 40, width & 0x7FFFFFFF, height & 0x7FFFFFFF, 1, int(pick(rng, (1, 8, 24, 32))), 0, 0, 0, 0, 0, 0
        )
        data = b"BM" + struct.pack("<3I", 100, 0, 54) + header + bytes(100)
    elif form == "TIFF":
        buffer = io.BytesIO()
        Image.new("L", (5, 7)).save(buffer, format="TIFF")
        data = (
            buffer.getvalue().replace(struct.pack("<2HI", 256, 4, 1), b"").replace(b"\x05\x00\x00\x00", struct.pack("<I", width))
        )
        data = data.replace(b"\x07\x00\x00\x00", struct.pack("<I", height))
    else:
        images.write_exr(folder / "a.exr", {"Y": np.ones((7, 5), np.float32)})
        content = (folder / "a.exr").read_bytes()
        window = struct.pack("<4i", 0, 0, 4, 6)
        data = content.replace(window, struct.pack("<4I", 0, 0, width, height))
    return _read(rng, folder, f".{form.lower()}", data, None)


def _exr(rng: np.random.Generator, folder: Path) -> str:
    names = pick(
        rng, (("R", "G", "B"), ("Y",), ("R", "G", "B", "A"), ("R",), ("Z", "N.x"), ("Y", "A"), ("R", "G", "B", "A", "depth.Z"))
    )
    height, width = int(pick(rng, _SIDES)), int(pick(rng, _SIDES))
    kind: Any = pick(rng, (np.float16, np.float32, np.uint32))
    channels = {name: rng.uniform(0, 2, (height, width)).astype(kind) for name in names}
    finite = chance(rng, 0.7)
    if not finite and kind is not np.uint32:
        with np.errstate(over="ignore"):
            for plane in channels.values():
                plane[int(rng.integers(height)), int(rng.integers(width))] = pick(rng, NUMBERS)
    path = folder / "picture.exr"
    images.write_exr(path, channels, {"note": "caf\u00e9"})
    sound = chance(rng, 0.3)
    if not sound:
        data = mutated(rng, path.read_bytes())
        return _read(rng, folder, ".exr", data, None)
    found, _ = images.read_exr(path)
    check(set(found) == set(names), f"channels {sorted(found)} instead of {sorted(names)}")
    check(all(np.array_equal(found[name], channels[name], equal_nan=kind is not np.uint32) for name in names), "other pixels")
    if chance(rng, 0.5):
        return f"{images.read_image(path).shape}"
    return _in_range(read_picture(path), (height, width, 4))


def _drawing(rng: np.random.Generator, folder: Path) -> str:
    """SVG drawings."""
    side = pick(rng, ("100", "0", "-5", "1e9", "100%", "1e-9", "nan", "3mm", ""))
    shapes = "".join(
        pick(
            rng,
            (
                '<circle cx="50" cy="50" r="30"/>',
                '<rect width="1e30" height="5"/>',
                '<path d="M0 0 L100 100 Z"/>',
                '<g transform="scale(0)">x</g>',
                '<text x="5" y="50">a</text>',
                '<image href="/etc/hostname" width="10" height="10"/>',
                '<use href="#a"/>',
                '<path d="M nan"/>',
            ),
        )
        for _ in range(int(rng.integers(4)))
    )
    box = pick(rng, ('viewBox="0 0 100 100"', "", 'viewBox="0 0 0 0"', 'viewBox="0 0 1 100000"'))
    text = f'<svg xmlns="http://www.w3.org/2000/svg" width="{side}" height="100" {box}>\n{shapes}\n</svg>'
    if chance(rng, 0.4):
        text = mutated_text(rng, text)
    data = text.encode("utf-8", "replace")
    if chance(rng, 0.3):
        data = gzip.compress(data)
        data = mutated(rng, data) if chance(rng, 0.3) else data
    path = folder / pick(rng, ("picture.svg", "picture.svgz"))
    path.write_bytes(data)
    return _checked_figure(read_figure(path))


def _figure(rng: np.random.Generator, folder: Path) -> str:
    """Figures in arrays."""
    return _checked_figure(figure_of(_pixels(rng)))


def _text(rng: np.random.Generator, folder: Path) -> str:
    words = ("A", "shadow", "", " ", "x" * 41, "é", "\u4e2d", "a\nb", "\x00", "\u200b", "i", ".", "W" * 40, "\U0001f600", "A\t")
    return _checked_figure(text_figure("".join(pick(rng, words) for _ in range(int(rng.integers(1, 4))))))


def _written(rng: np.random.Generator, folder: Path) -> str:
    """Arrays of any shape written and read again."""
    shape = tuple(int(n) for n in rng.integers(0, 6, int(rng.integers(1, 5))))
    values = rng.uniform(0, 1, shape).astype(pick(rng, (np.float32, np.float64, np.float16)))
    if values.size and chance(rng, 0.3):
        with np.errstate(over="ignore"):
            values.flat[0] = pick(rng, NUMBERS)
    path = folder / f"picture{pick(rng, ('.png', '.exr', '.PNG', '.jpg', ''))}"
    images.write_image(path, values)
    pixels = read_picture(path) if path.suffix.lower() == ".png" or chance(rng, 0.5) else images.read_image(path)
    if values.ndim not in (2, 3) or pixels.shape[:2] != values.shape[:2]:
        raise ShadowmapError(f"unexpected: {values.shape} became {pixels.shape}")
    return f"{values.shape}"

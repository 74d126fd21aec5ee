"""Pictures that others wrote: all formats, and bombs."""

from __future__ import annotations

import gzip
import io
import resource
import struct
import subprocess
import sys
import warnings
import zipfile
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.faces.silhouette import read_silhouette
from shadowmap_dr.inverse.shadow_art import drawings
from shadowmap_dr.inverse.shadow_art.target_images import read_figure
from shadowmap_dr.io import files, images, pictures
from shadowmap_dr.io.pictures import LONGER_SIDE, read_picture, read_pixels


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _png(width: int, height: int) -> bytes:
    header = struct.pack(">2I5B", width, height, 8, 6, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", header) + _chunk(b"IDAT", zlib.compress(bytes(100))) + _chunk(b"IEND", b"")


def _bmp(width: int, height: int) -> bytes:
    info = struct.pack("<IiiHHIIiiII", 40, width, height, 1, 24, 0, 0, 0, 0, 0, 0)
    return b"BM" + struct.pack("<IHHI", 54, 0, 0, 54) + info


def _gif(width: int, height: int) -> bytes:
    frame = b"," + struct.pack("<4HB", 0, 0, width, height, 0) + b"\x02\x02\x4c\x01\x00;"
    return b"GIF89a" + struct.pack("<2H3B", width, height, 0x80, 0, 0) + bytes(6) + frame


def _tiff(width: int, height: int) -> bytes:
    tags = [(256, width), (257, height), (258, 8), (259, 1), (262, 1), (273, 8), (277, 1), (278, height), (279, 100)]
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
    return b"II*\0" + struct.pack("<I", 8) + struct.pack("<H", len(tags)) + entries + struct.pack("<I", 0)


def _exr(width: int, height: int, folder: Path) -> bytes:
    images.write_exr(folder / "small.exr", {"Y": np.zeros((4, 4), np.float32)})
    data, name = (folder / "small.exr").read_bytes(), b"dataWindow\0box2i\0"
    at = data.index(name) + len(name) + 4
    return data[:at] + struct.pack("<4i", 0, 0, width - 1, height - 1) + data[at + 16 :]


_WRITERS = {"png": _png, "bmp": _bmp, "gif": _gif, "tif": _tiff}


@pytest.mark.parametrize("suffix", [*_WRITERS, "exr"])
@pytest.mark.parametrize(("width", "height"), [(9000, 8000), (60000, 60000)])
def test_bombs_are_refused_before_they_are_decoded(tmp_path: Path, suffix: str, width: int, height: int) -> None:
    path = tmp_path / f"bomb.{suffix}"
    path.write_bytes(_exr(width, height, tmp_path) if suffix == "exr" else _WRITERS[suffix](width, height))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for read in (read_silhouette, read_figure):
        with pytest.raises(ShadowmapError, match=rf"bomb\.{suffix}.*MB decoded.*at most 64000000 pixels and 1000 MB") as caught:
            read(path)
        message = str(caught.value)
        assert (f"{width} x {height}" in message or str(width * height) in message) and "\n" not in message
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kilobytes


@pytest.mark.parametrize("name", ["a.png", "a.webp", "a.gif", "a.bmp", "a.tif", "a.exr"])
def test_all_formats_show_the_same(tmp_path: Path, name: str) -> None:
    grey = np.full((40, 30), 255, np.uint8)
    grey[10:30, 5:20] = 0
    if name == "a.exr":
        images.write_image(tmp_path / name, (grey / 255)[..., None])
    else:
        Image.fromarray(grey).save(tmp_path / name, **({"lossless": True} if name == "a.webp" else {}))
    np.testing.assert_array_equal((read_picture(tmp_path / name)[..., 0] * 255).round(), grey)
    np.testing.assert_array_equal(read_figure(tmp_path / name) > 0.5, grey == 0)
    np.testing.assert_array_equal(read_silhouette(tmp_path / name) < 0.5, grey == 0)


def test_large_pictures_are_shrunk_and_cut_ones_refused(tmp_path: Path) -> None:
    grey = np.full((6000, 90), 255, np.uint8)
    grey[1500:3000] = 0
    Image.fromarray(grey).save(tmp_path / "large.png")
    picture = read_picture(tmp_path / "large.png")
    assert max(picture.shape) <= LONGER_SIDE and picture[..., 0].mean() == pytest.approx(0.75, abs=1e-3)
    data = (tmp_path / "large.png").read_bytes()
    (tmp_path / "cut.png").write_bytes(data[: len(data) // 2])
    with pytest.raises(ShadowmapError, match="cut.png: it is no image, or it is damaged"):
        read_picture(tmp_path / "cut.png")


def test_floating_point_tiffs_are_not_clipped_at_bytes(tmp_path: Path) -> None:
    Image.fromarray(np.array([[0, 0.2140], [1, np.nan]], np.float32)).save(tmp_path / "a.tif")
    np.testing.assert_allclose(read_picture(tmp_path / "a.tif")[..., 1], [[0, 0.5], [1, 0]], atol=1e-4)


def test_archives_of_zeros_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    array = io.BytesIO()
    np.save(array, np.zeros(100_000))
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("x.npy", array.getvalue())
    monkeypatch.setattr(files, "MOST_DECODED", 500_000)
    with pytest.raises(ShadowmapError, match=r"a\.npz: its arrays take 1 MB, more than 0 MB"):
        files.read_arrays(tmp_path / "a.npz")
    assert files.read_arrays(tmp_path / "a.npz", ("y",)) == {}


def _drawing(path: Path, attributes: str, content: str) -> Path:
    path.write_text(f'<svg xmlns="http://www.w3.org/2000/svg" {attributes}>{content}</svg>')
    return path


def test_drawings_end_their_own_process_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever ends or stops the rasterizer is one line here."""
    pytest.importorskip("resvg_py")
    path = _drawing(tmp_path / "a.svg", 'width="30" height="20"', '<rect width="9" height="9"/>')
    assert np.abs(np.subtract(read_figure(path).shape, (683, 1024))).max() <= 2
    for child, reason in (
        ("import os; os.abort()", "the rasterizer ended"),
        ("import time; time.sleep(60)", "more than 0.5 seconds"),
    ):
        monkeypatch.setattr(drawings, "_CHILD", child)
        monkeypatch.setattr(drawings, "_MOST_SECONDS", 0.5)
        with pytest.raises(ShadowmapError, match=rf"a\.svg: .*{reason}"):
            read_figure(path)


def test_modules_in_the_current_folder_are_not_the_rasterizers(tmp_path: Path) -> None:
    pytest.importorskip("resvg_py")
    _drawing(tmp_path / "a.svg", 'width="30" height="20"', '<rect width="9" height="9"/>')
    (tmp_path / "resvg_py.py").write_text("raise SystemExit(7)")
    code = (
        "import sys; sys.path.remove(''); import resvg_py; sys.path.insert(0, '')\n"
        "from shadowmap_dr.inverse.shadow_art.target_images import read_figure; print(read_figure('a.svg').shape)"
    )
    run = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert run.stdout.startswith("("), run.stderr


def test_texts_of_drawings_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("resvg_py")
    monkeypatch.setattr(drawings, "_MOST_BYTES", 10_000)
    with gzip.open(tmp_path / "a.svgz", "w") as file:
        file.write(b" " * 100_000 + b"<svg/>")
    with pytest.raises(ShadowmapError, match=r"a\.svgz: the drawing has more than 10000 bytes"):
        read_figure(tmp_path / "a.svgz")


def test_bright_premultiplied_colours_are_white(tmp_path: Path) -> None:
    plane = np.full((4, 5), 3e38, np.float32)
    images.write_exr(tmp_path / "a.exr", {**dict.fromkeys("RGB", plane), "A": np.full((4, 5), 1e-3, np.float32)})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        picture = read_picture(tmp_path / "a.exr")
    assert picture[..., :3].min() > 0.999


@pytest.mark.parametrize("box", ["0 0 0 0", "0 0 100 0", "0 0 -1 5", "0 0 nan 5"])
def test_drawings_with_empty_boxes_are_refused(tmp_path: Path, box: str) -> None:
    path = _drawing(tmp_path / "a.svg", f'viewBox="{box}" width="100"', '<circle r="5"/>')
    with pytest.raises(ShadowmapError, match=r"a\.svg: it is no drawing"):
        read_figure(path)


# ------------------------------------------------------------------------------------------------ 16 bits, orientation, alpha


def _deep(channels: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 65536, (9, 6, channels)).astype(np.uint16)


def _png16(values: np.ndarray, extra: bytes = b"") -> bytes:
    """A PNG file of 16 bits a channel, written without a library."""
    height, width, channels = values.shape
    header = struct.pack(">2I5B", width, height, 16, {1: 0, 2: 4, 3: 2, 4: 6}[channels], 0, 0, 0)
    lines = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", header) + extra + _chunk(b"IDAT", zlib.compress(lines)) + _chunk(b"IEND", b"")


def _rgba(values: np.ndarray) -> np.ndarray:
    """Red, green, blue and alpha of grey or coloured values without or with alpha."""
    opaque = np.full_like(values[..., :1], np.iinfo(values.dtype).max)
    alpha = values[..., -1:] if values.shape[2] in (2, 4) else opaque
    colours = values[..., :3] if values.shape[2] >= 3 else np.repeat(values[..., :1], 3, axis=2)
    return np.concatenate([colours, alpha], axis=2)


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_deep_pngs_keep_their_precision(tmp_path: Path, channels: int) -> None:
    values = _deep(channels)
    (tmp_path / "a.png").write_bytes(_png16(values))
    found = read_pixels(tmp_path / "a.png")
    assert found.dtype == np.uint16
    np.testing.assert_array_equal(found, _rgba(values))
    np.testing.assert_array_equal(read_pixels("name", _png16(values)), found)


@pytest.mark.parametrize("channels", [1, 3])
def test_deep_pngs_with_a_transparent_colour(tmp_path: Path, channels: int) -> None:
    values = _deep(channels)
    (tmp_path / "a.png").write_bytes(_png16(values, _chunk(b"tRNS", values[2, 3].astype(">u2").tobytes())))
    found = read_pixels(tmp_path / "a.png")
    assert found[2, 3, 3] == 0 and (found[..., 3] == 65535).sum() == 53
    np.testing.assert_array_equal(found[..., :3], _rgba(values)[..., :3])


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("compression", [1, 5, 8, 32773])
def test_deep_tiffs_keep_their_precision(tmp_path: Path, channels: int, compression: int) -> None:
    values = _deep(channels)
    bgr = values[..., [2, 1, 0, 3][:channels]] if channels > 1 else values
    cv2.imwrite(str(tmp_path / "a.tif"), bgr, [cv2.IMWRITE_TIFF_COMPRESSION, compression, cv2.IMWRITE_TIFF_ROWSPERSTRIP, 4])
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.tif"), _rgba(values))


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("extra", [None, 0, 1, 2])
def test_deep_tiffs_of_both_byte_orders_and_kinds_of_alpha(tmp_path: Path, order: str, extra: int | None) -> None:
    channels = 3 if extra is None else 4
    values = _deep(channels)
    if extra == 1:  # premultiplied
        values[..., :3] = (values[..., :3] * (values[..., 3:] / 65535.0)).astype(np.uint16)
    (tmp_path / "a.tif").write_bytes(_tiff16(values, order, extra))
    found = read_pixels(tmp_path / "a.tif")
    expected = _rgba(values if extra else values[..., :3])
    if extra == 1:
        straight = values[..., :3] / np.maximum(values[..., 3:], 1.0) * 65535
        np.testing.assert_allclose(found[..., :3], straight.clip(0, 65535), atol=0.5)
        np.testing.assert_array_equal(found[..., 3], values[..., 3])
    else:
        np.testing.assert_array_equal(found, expected)


def _tiff16(values: np.ndarray, order: str, extra: int | None) -> bytes:
    """An uncompressed TIFF file of 16 bits a channel, written without a library. ``extra``: kind of the fourth channel."""
    height, width, channels = values.shape
    pixels = values.astype(f"{order}u2").tobytes()
    count = 11 if extra is None else 12
    bits_at = 8 + 2 + 12 * count + 4
    pixels_at = bits_at + 2 * channels
    tags = [(256, 4, 1, width), (257, 4, 1, height), (258, 3, channels, bits_at), (259, 3, 1, 1), (262, 3, 1, 2)]
    tags += [(273, 4, 1, pixels_at), (274, 3, 1, 1), (277, 3, 1, channels), (278, 4, 1, height), (279, 4, 1, len(pixels))]
    tags += [(284, 3, 1, 1)] + ([] if extra is None else [(338, 3, 1, extra)])
    entries = b""
    for tag, kind, number, value in tags:
        short = kind == 3 and number == 1
        entries += struct.pack(f"{order}HHI", tag, kind, number) + struct.pack(
            f"{order}{'HH' if short else 'I'}", value, *[0] * short
        )
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(f"{order}IH", 8, count)
    return head + entries + bytes(4) + struct.pack(f"{order}{channels}H", *[16] * channels) + pixels


def test_pictures_in_full_precision(tmp_path: Path) -> None:
    values = np.linspace(0, 65535, 54).reshape(9, 6, 1).astype(np.uint16)
    (tmp_path / "a.png").write_bytes(_png16(values))
    np.testing.assert_allclose(read_picture(tmp_path / "a.png")[..., 0], values[..., 0] / 65535, rtol=1e-6)


@pytest.mark.parametrize("suffix", ["png", "jpg", "tif", "webp"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_pictures_are_upright(tmp_path: Path, suffix: str, orientation: int) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    values = np.random.default_rng(0).integers(0, 256, (5, 7, 3)).astype(np.uint8)
    Image.fromarray(values).save(tmp_path / f"a.{suffix}", exif=exif, **({"lossless": True} if suffix == "webp" else {}))
    with Image.open(tmp_path / f"a.{suffix}") as image:
        image.load()
        expected = np.asarray(ImageOps.exif_transpose(image))
    assert expected.shape == ((5, 7, 3) if orientation < 5 else (7, 5, 3))
    np.testing.assert_array_equal(read_pixels(tmp_path / f"a.{suffix}")[..., :3], expected)


def test_damaged_orientation_and_deep_ones(tmp_path: Path) -> None:
    values = _deep(3)
    exif = Image.Exif()
    exif[0x0112] = 6
    (tmp_path / "a.png").write_bytes(_png16(values, _chunk(b"eXIf", exif.tobytes()[6:])))
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.png")[..., :3], np.rot90(values, -1))
    for bad in (b"II*\0\xff\xff\xff\xff", b"nonsense", exif.tobytes()[6:20]):
        (tmp_path / "b.png").write_bytes(_png16(values, _chunk(b"eXIf", bad)))
        np.testing.assert_array_equal(read_pixels(tmp_path / "b.png")[..., :3], values)


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_cut_deep_pictures_are_refused(tmp_path: Path, share: float) -> None:
    cv2.imwrite(str(tmp_path / "whole.tif"), _deep(3))
    for name, data in (("a.png", _png16(_deep(3))), ("a.tif", (tmp_path / "whole.tif").read_bytes())):
        (tmp_path / name).write_bytes(data[: int(share * len(data))])
        with pytest.raises(ShadowmapError, match="it is no image, or it is damaged"):
            read_pixels(tmp_path / name)


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "PA", "RGB", "RGBA", "CMYK"])
def test_all_modes_as_pillow_shows_them(tmp_path: Path, mode: str) -> None:
    values = np.random.default_rng(0).integers(0, 256, (5, 7, 4)).astype(np.uint8)
    image = Image.fromarray(values).convert("RGB" if mode == "CMYK" else "RGBA").convert(mode)
    path = tmp_path / ("a.tif" if mode in ("CMYK", "PA") else "a.png")
    image.save(path)
    with Image.open(path) as again:
        np.testing.assert_array_equal(read_pixels(path), np.asarray(again.convert("RGBA")))


def test_large_deep_pictures_are_shrunk_without_their_transparent_colours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pictures, "LONGER_SIDE", 3)
    values = _deep(4)
    (tmp_path / "a.png").write_bytes(_png16(values))
    found = read_picture(tmp_path / "a.png")
    assert found.shape == (3, 2, 4)
    parts = (values / 65535).reshape(3, 3, 2, 3, 4)
    alpha = parts[..., 3:].mean((1, 3))
    np.testing.assert_allclose(found[..., 3:], alpha, rtol=1e-5)
    np.testing.assert_allclose(found[..., :3], (parts[..., :3] * parts[..., 3:]).mean((1, 3)) / alpha, rtol=1e-5)

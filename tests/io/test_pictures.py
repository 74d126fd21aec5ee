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

import numpy as np
import pytest
from PIL import Image

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.faces.silhouette import read_silhouette
from shadowmap_dr.inverse.shadow_art import drawings
from shadowmap_dr.inverse.shadow_art.target_images import read_figure
from shadowmap_dr.io import files, images
from shadowmap_dr.io.pictures import LONGER_SIDE, read_picture


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
    np.testing.assert_array_equal(read_picture(tmp_path / "a.tif")[..., 1] * 255, [[0, 127], [255, 0]])


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

"""Cameras of a reconstruction by COLMAP: `cameras` and `images`, as text or binary files.

Formats: https://colmap.github.io/format.html. Pixel centres lie at + 0.5 there, as in :class:`~shadowmap_dr.cameras.Camera`.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from ..errors import ShadowmapError
from .camera import Camera, rotation_from_quaternion

Numbers = Sequence[float]
T = TypeVar("T")


@dataclass(frozen=True)
class _Model:
    """A camera model: its number of parameters, and (focal lengths, principal point, distortion, fisheye) from them."""

    name: str
    count: int
    read: Callable[[Numbers], tuple[Numbers, Numbers, Numbers, bool]] | None = None


# In the order of COLMAP's numbers. Models without `read` have no counterpart in OpenCV.
_MODELS = (
    _Model("SIMPLE_PINHOLE", 3, lambda p: ((p[0], p[0]), p[1:3], (), False)),
    _Model("PINHOLE", 4, lambda p: (p[:2], p[2:4], (), False)),
    _Model("SIMPLE_RADIAL", 4, lambda p: ((p[0], p[0]), p[1:3], (p[3], 0, 0, 0), False)),
    _Model("RADIAL", 5, lambda p: ((p[0], p[0]), p[1:3], (p[3], p[4], 0, 0), False)),
    _Model("OPENCV", 8, lambda p: (p[:2], p[2:4], p[4:], False)),
    _Model("OPENCV_FISHEYE", 8, lambda p: (p[:2], p[2:4], p[4:], True)),
    _Model("FULL_OPENCV", 12, lambda p: (p[:2], p[2:4], p[4:], False)),
    _Model("FOV", 5),
    _Model("SIMPLE_RADIAL_FISHEYE", 4, lambda p: ((p[0], p[0]), p[1:3], (p[3], 0, 0, 0), True)),
    _Model("RADIAL_FISHEYE", 5, lambda p: ((p[0], p[0]), p[1:3], (p[3], p[4], 0, 0), True)),
    _Model("THIN_PRISM_FISHEYE", 12),
)
_BY_NAME = {model.name: model for model in _MODELS}


@dataclass(frozen=True)
class _Lens:
    model: _Model
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True)
class _View:
    name: str
    lens: int
    quaternion: tuple[float, ...]
    translation: tuple[float, ...]


def from_colmap(folder: str | os.PathLike[str]) -> dict[str, Camera]:
    """Cameras of all images of a reconstruction, by the images' names, sorted.

    Args:
        folder: with ``cameras.bin`` and ``images.bin``, or the same as text (``.txt``); or one whose ``sparse/0`` has them.

    Raises:
        ShadowmapError: A missing or damaged file; a camera model without counterpart in OpenCV (FOV, THIN_PRISM_FISHEYE).
    """
    start = Path(folder)
    for place in (start, start / "sparse" / "0", start / "sparse", start / "0"):
        for suffix in (".bin", ".txt"):
            lenses, views = place / f"cameras{suffix}", place / f"images{suffix}"
            if lenses.is_file() and views.is_file():
                binary = suffix == ".bin"
                read = _parsed(lenses, _binary_lenses if binary else _text_lenses)
                return _cameras(views, read, _parsed(views, _binary_views if binary else _text_views))
    raise ShadowmapError(f"{start} has no cameras.bin and images.bin (or .txt): give the folder of a COLMAP reconstruction.")


def _cameras(path: Path, lenses: dict[int, _Lens], views: list[_View]) -> dict[str, Camera]:
    found = {}
    for view in sorted(views, key=lambda one: one.name):
        lens = lenses.get(view.lens)
        if lens is None:
            raise ShadowmapError(f"{path}: image {view.name!r} has camera {view.lens}, which the file of cameras does not have.")
        if lens.model.read is None:
            raise ShadowmapError(
                f"{path}: image {view.name!r} has a lens of the model {lens.model.name}, which is not supported: "
                "undistort the images with COLMAP's image_undistorter first."
            )
        (fx, fy), (cx, cy), distortion, fisheye = lens.model.read(lens.parameters)
        rotation = rotation_from_quaternion(view.quaternion)
        where = rotation, np.array(view.translation)
        found[view.name] = Camera(lens.width, lens.height, fx, fy, cx, cy, *where, tuple(distortion), fisheye, view.name)
    return found


def _parsed(path: Path, parse: Callable[[bytes], T]) -> T:
    try:
        return parse(path.read_bytes())
    except ShadowmapError as error:
        raise ShadowmapError(f"{path}: {error}") from None
    except (ValueError, IndexError, struct.error) as error:
        raise ShadowmapError(f"{path} is damaged, or no file of COLMAP's ({error}).") from None
    except OSError as error:
        raise ShadowmapError(f"{path} cannot be read: {error.strerror}.") from None


def _lens(model: _Model, width: int, height: int, parameters: Sequence[float]) -> _Lens:
    if len(parameters) != model.count:
        raise ValueError(f"{len(parameters)} parameters for the model {model.name}, which has {model.count}")
    return _Lens(model, width, height, tuple(parameters))


# ------------------------------------------------------------------------------------------------------------------- text


def _lines(data: bytes) -> list[str]:
    return [line.strip() for line in data.decode("utf-8", "surrogateescape").splitlines() if not line.lstrip().startswith("#")]


def _text_lenses(data: bytes) -> dict[int, _Lens]:
    lenses = {}
    for line in filter(None, _lines(data)):
        number, name, width, height, *parameters = line.split()
        if name not in _BY_NAME:
            raise ShadowmapError(f"the camera model {name!r} is not known.")
        lenses[int(number)] = _lens(_BY_NAME[name], int(width), int(height), [float(word) for word in parameters])
    return lenses


def _text_views(data: bytes) -> list[_View]:
    """Each image has two lines; the second, with points that it shows, may be empty."""
    lines = _lines(data)
    while lines and not lines[0]:
        del lines[0]
    views = []
    for line in filter(None, lines[::2]):
        _, *numbers, camera, name = line.split(maxsplit=9)
        if len(numbers) != 7:
            raise ValueError("an image has not all of its ten entries")
        values = [float(word) for word in numbers]
        views.append(_View(name, int(camera), tuple(values[:4]), tuple(values[4:])))
    return views


# ----------------------------------------------------------------------------------------------------------------- binary


class _Reader:
    """Numbers from the front of bytes, little-endian."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def take(self, layout: str) -> tuple[float, ...]:
        found = struct.unpack_from("<" + layout, self.data, self.at)
        self.at += struct.calcsize("<" + layout)
        return found

    def word(self) -> str:
        end = self.data.index(b"\0", self.at)
        text = self.data[self.at : end].decode("utf-8", "surrogateescape")
        self.at = end + 1
        return text

    def skip(self, count: int) -> None:
        self.at += count
        if self.at > len(self.data):
            raise ValueError("it ends early")


def _binary_lenses(data: bytes) -> dict[int, _Lens]:
    reader, lenses = _Reader(data), {}
    for _ in range(int(reader.take("Q")[0])):
        number, kind, width, height = (int(value) for value in reader.take("IiQQ"))
        if not 0 <= kind < len(_MODELS):
            raise ShadowmapError(f"the camera model with the number {kind} is not known.")
        lenses[number] = _lens(_MODELS[kind], width, height, reader.take(f"{_MODELS[kind].count}d"))
    return lenses


def _binary_views(data: bytes) -> list[_View]:
    reader, views = _Reader(data), []
    for _ in range(int(reader.take("Q")[0])):
        _, *values = reader.take("I7d")
        (lens,), name = reader.take("I"), reader.word()
        reader.skip(24 * int(reader.take("Q")[0]))
        views.append(_View(name, int(lens), tuple(values[:4]), tuple(values[4:])))
    return views

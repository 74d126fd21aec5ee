"""Cameras of a `transforms.json`, as NeRF, instant-ngp and nerfstudio write it."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ShadowmapError
from .camera import Camera

# OpenGL's camera looks along -z and has y up; OpenCV's looks along +z and has y down.
_FLIP = np.diag([1.0, -1.0, -1.0])
_FISHEYE = ("OPENCV_FISHEYE",)
_PLAIN = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")


def from_nerf(path: str | os.PathLike[str], width: int | None = None, height: int | None = None) -> dict[str, Camera]:
    """Cameras of all frames, by their ``file_path``, in the file's order.

    Args:
        path: of the JSON file.
        width, height: of the pictures, pixels, for files that do not say it. Without them, the pictures are looked at, which lie
            beside the file.

    Raises:
        ShadowmapError: A missing or damaged file; no focal length; a camera model without counterpart in OpenCV.
    """
    source = Path(path)
    try:
        data = json.loads(source.read_text(encoding="utf-8"))
    except OSError as error:
        raise ShadowmapError(f"{source} cannot be read: {error.strerror}.") from None
    except ValueError:
        raise ShadowmapError(f"{source} is no JSON file.") from None
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise ShadowmapError(f"{source} has no list 'frames': give a transforms.json of NeRF, instant-ngp or nerfstudio.")
    found: dict[str, Camera] = {}
    for number, frame in enumerate(frames):
        name = str(frame.get("file_path", number))
        try:
            found[name] = _camera({**data, **frame}, name, _size(source, {**data, **frame}, name, width, height))
        except ShadowmapError as error:
            raise ShadowmapError(f"{source}, frame {name!r}: {error}") from None
    return found


def _size(source: Path, values: Mapping[str, Any], name: str, width: int | None, height: int | None) -> tuple[int, int]:
    if width and height:
        return width, height
    if "w" in values and "h" in values:
        return int(_positive(values, "w")), int(_positive(values, "h"))
    from PIL import Image

    for file in (source.parent / name, *(source.parent / f"{name}{suffix}" for suffix in (".png", ".jpg", ".jpeg"))):
        if file.is_file():
            with Image.open(file) as picture:
                return picture.size
    raise ShadowmapError(
        "the size of its picture is unknown, as neither w and h nor the picture are there: give width and height."
    )


def _camera(values: Mapping[str, Any], name: str, size: tuple[int, int]) -> Camera:
    width, height = size
    model = str(values.get("camera_model", "OPENCV")).upper()
    if model not in _PLAIN + _FISHEYE:
        raise ShadowmapError(f"the camera model {model!r} is not supported: undistort the pictures first.")
    # A file that names another size than the pictures have, for smaller copies of them.
    scale_x = width / _positive(values, "w") if "w" in values else 1.0
    scale_y = height / _positive(values, "h") if "h" in values else 1.0
    fx, fy = (_focal(values, axis, side) for axis, side in (("x", width / scale_x), ("y", height / scale_y)))
    fx, fy = (fy if fx is None else fx), (fx if fy is None else fy)
    if fx is None or fy is None:
        raise ShadowmapError("it has no focal length (fl_x) and no angle (camera_angle_x).")
    try:
        matrix = np.array(values.get("transform_matrix", ()), np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape not in ((4, 4), (3, 4)) or not np.isfinite(matrix).all():
        raise ShadowmapError("its transform_matrix has not 4 x 4 numbers.")
    linear = matrix[:3, :3]
    scale = float(np.cbrt(abs(np.linalg.det(linear)))) or 1.0
    rotation = (linear / scale @ _FLIP).T
    keys = ("k1", "k2", "k3", "k4") if model in _FISHEYE else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    distortion = tuple(_number(values, key) if key in values else 0.0 for key in keys)
    return Camera(
        width=width,
        height=height,
        fx=fx * scale_x,
        fy=fy * scale_y,
        cx=(_number(values, "cx") * scale_x) if "cx" in values else 0.5 * width,
        cy=(_number(values, "cy") * scale_y) if "cy" in values else 0.5 * height,
        rotation=rotation,
        translation=-rotation @ matrix[:3, 3],
        distortion=distortion,
        fisheye=model in _FISHEYE,
        name=name,
    )


def _focal(values: Mapping[str, Any], axis: str, side: float) -> float | None:
    if f"fl_{axis}" in values:
        return _positive(values, f"fl_{axis}")
    if f"camera_angle_{axis}" in values:
        return 0.5 * side / math.tan(0.5 * _positive(values, f"camera_angle_{axis}"))
    return None


def _positive(values: Mapping[str, Any], key: str) -> float:
    number = _number(values, key)
    if number <= 0:
        raise ShadowmapError(f"{key} is {number:g}: a positive number is needed.")
    return number


def _number(values: Mapping[str, Any], key: str) -> float:
    value = values[key]
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ShadowmapError(f"{key} is {value!r}: a number is needed.")
    return float(value)

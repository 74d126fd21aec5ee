"""Pictures that a scene is fitted to: linear colours, and a weight for each pixel."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import PurePath
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError, quoted
from ..io.images import to_linear
from ..io.pictures import read_pixels
from ..io.resampling import area_average
from .fireflies import fireflies

Array: TypeAlias = npt.NDArray[np.float32]

#: Most pixels along the longer side of a target that is read; larger pictures are reduced to it.
LONGER_SIDE = 2048
#: Largest exposure: images times it are numbers in single precision.
MOST_EXPOSED = 1e6
#: Smallest value of a saturated channel, of 8 and 16 bits, as a fraction of the largest one.
SATURATED = 254 / 255

# The largest single-precision number.
_MOST = float(np.finfo(np.float32).max)


@dataclass(frozen=True, eq=False)
class Target:
    """A picture of the scene, linear, and the weights of its pixels.

    ``image`` float32 (H, W, 3), finite, not negative. ``weight`` float32 (H, W) in 0..1: 0 for masked, transparent and saturated
    pixels, and for pixels that are not finite; there ``image`` is 0, too. ``sensor``: number of the scene's sensor that took it.
    ``name``: path of the file, for messages. ``exposure``: known exposure, the factor of the rendered colours, as in fit.toml.
    ``opaque``: for linear pictures with alpha, the same with colours as they are in the file, where transparent pixels count.
    """

    image: Array
    weight: Array
    sensor: int = 0
    name: str = ""
    exposure: float = 1.0
    opaque: Target | None = None

    def __post_init__(self) -> None:
        if not 0 < self.exposure <= MOST_EXPOSED:
            raise ShadowmapError(
                f"{self._named}: exposure is {quoted(self.exposure)}; give a positive number up to {MOST_EXPOSED:g}."
            )

    @property
    def width(self) -> int:
        """Pixels of a row."""
        return self.image.shape[1]

    @property
    def height(self) -> int:
        """Number of rows."""
        return self.image.shape[0]

    def resized(self, width: int, height: int) -> Target:
        """The picture with fewer pixels: averages over the area of each, exact also if sides do not divide.

        Colours are averaged by their weights, so masked pixels have no share in them. Weights are averaged over the area.

        Raises:
            ShadowmapError: A size that is larger, not positive, or of another aspect ratio (by more than a pixel).
        """
        if width < 1 or height < 1:
            raise ShadowmapError(f"{self._named}: {width} x {height} pixels are no size: give positive numbers.")
        if width > self.width or height > self.height:
            raise ShadowmapError(
                f"{self._named} has {self.width} x {self.height} pixels, fewer than {width} x {height}: give a larger picture, "
                "or fit at a lower resolution."
            )
        if not is_same_shape((self.height, self.width), (height, width)):
            raise ShadowmapError(
                f"{self._named} has {self.width} x {self.height} pixels, but {width} x {height} are wanted, of another aspect "
                f"ratio: crop the picture, or give the sensor's film {_fitting_film(self.width, self.height, width, height)}."
            )
        if (height, width) == self.weight.shape:
            return self

        def rows(at: slice) -> Array:
            weight = self.weight[at, :, None]
            return np.concatenate([self.image[at] * weight, weight], axis=-1)

        image, weight = _divided(area_average(rows, self.weight.shape, (height, width)))
        opaque = None if self.opaque is None else self.opaque.resized(width, height)
        return replace(self, image=image, weight=weight, opaque=opaque)

    @property
    def _named(self) -> str:
        return self.name or "the target"


def read_target(
    path: str | os.PathLike[str],
    mask: str | os.PathLike[str] | npt.ArrayLike | None = None,
    *,
    sensor: int = 0,
    saturation: float | None = None,
    longer_side: int = LONGER_SIDE,
    exposure: float = 1.0,
) -> Target:
    """Read a target from a picture file.

    OpenEXR and floating-point TIFF are linear, all others sRGB, of 8 or 16 bits. Pictures are turned as EXIF says. The weight of
    a pixel is its alpha times its mask; saturated pixels, those that are not finite, and fireflies (single pixels of linear
    pictures, many times brighter than nearly all others and than their neighbours) have none.

    Args:
        path: picture file.
        mask: picture file, or array (H, W) of bool, of integers up to their type's largest, or of floats in 0..1: white counts.
            It may have another size than the picture, of the same aspect ratio. In a file, transparent parts are black.
        sensor: number of the scene's sensor that took the picture.
        saturation: least value of a saturated channel: a fraction of the largest value in sRGB pictures, a linear value in linear
            ones. None: :data:`SATURATED` in the former, no limit in the latter. ``inf``: no pixel is saturated.
        longer_side: larger pictures are reduced to so many pixels along their longer side.
        exposure: known exposure of the picture, the factor of the rendered colours.

    Raises:
        ShadowmapError: A file that does not exist, is damaged, or too large; a mask of another aspect ratio; no pixel counts.
    """
    pixels = read_pixels(path)
    if saturation is None:
        saturation = np.inf if pixels.dtype == np.float32 else SATURATED
    return _target(pixels, mask, sensor, str(path), saturation, longer_side, exposure)


def make_target(
    image: Any,  # Any: an array of NumPy, Dr.Jit or PyTorch
    mask: str | os.PathLike[str] | npt.ArrayLike | None = None,
    *,
    sensor: int = 0,
    name: str = "the target",
    saturation: float = np.inf,
    longer_side: int = LONGER_SIDE,
    exposure: float = 1.0,
) -> Target:
    """Make a target from an array. No gradients flow to it.

    Args:
        image: floats (H, W), (H, W, 1), (H, W, 3), or (H, W, 4), linear, as Mitsuba's renderings: a fourth channel is alpha, by
            which the colours are multiplied. An array of NumPy, a tensor of Dr.Jit, or whatever NumPy can convert.
        mask, sensor, saturation, longer_side, exposure: see :func:`read_target`.
        name: for messages.

    Raises:
        ShadowmapError: An array of another shape, of integers, or empty; see also :func:`read_target`.
    """
    values = _array(image, name)
    if values.dtype.kind != "f":
        raise ShadowmapError(
            f"{name} is an array of {values.dtype}: give linear floats; of sRGB bytes they are shadowmap_dr.io.images.to_linear"
            "(image / 255)."
        )
    if values.ndim == 2:
        values = values[..., None]
    if values.ndim != 3 or values.shape[2] not in (1, 3, 4) or not values.size:
        raise ShadowmapError(
            f"{name} has the shape {np.shape(image)}: give an array (H, W), (H, W, 3) or, with alpha, (H, W, 4), not empty."
        )
    with np.errstate(over="ignore"):  # infinite pixels do not count
        values = values.astype(np.float32)
    if values.shape[2] < 4:
        colours = np.broadcast_to(values, (*values.shape[:2], 3))
        values = np.concatenate([colours, np.ones_like(values[..., :1])], axis=-1)
    return _target(values, mask, sensor, name, saturation, longer_side, exposure)


def short_names(targets: Sequence[Target]) -> list[str]:
    """Names of pictures for results, none twice: those of the files, with as many folders as tell them apart.

    Pictures of one path, or of arrays, have the number of their sensor or their place in addition. A single picture without a
    name has none.
    """
    paths = [PurePath(target.name).parts for target in targets]
    names = []
    for own in paths:
        others = [other for other in paths if other != own]
        count = next((k for k in range(1, len(own)) if all(other[-k:] != own[-k:] for other in others)), len(own))
        names.append(str(PurePath(*own[len(own) - count :])) if own else "")
    return [name if names.count(name) == 1 else _numbered(targets, names, place) for place, name in enumerate(names)]


def _numbered(targets: Sequence[Target], names: Sequence[str], place: int) -> str:
    """The name of a picture that others have, too, with a number."""
    group = [k for k, name in enumerate(names) if name == names[place]]
    sensors = [targets[k].sensor for k in group]
    number = f"sensor {targets[place].sensor}" if len(set(sensors)) == len(group) else f"{group.index(place) + 1} of {len(group)}"
    return f"{names[place] or 'the picture'} ({number})"


def is_same_shape(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """True if two sizes (height, width) have the same aspect ratio, but for one rounded side."""
    (height, width), (other_height, other_width) = min(size, other), max(size, other)
    return abs(other_width * height / other_height - width) < 1 or abs(other_height * width / other_width - height) < 1


# ------------------------------------------------------------------------------------------------------------------- pixels


def _target(
    pixels: npt.NDArray[Any],
    mask: str | os.PathLike[str] | npt.ArrayLike | None,
    sensor: int,
    name: str,
    saturation: float,
    longer_side: int,
    exposure: float,
) -> Target:
    """A target of pixels as :func:`read_pixels` returns them."""
    if not saturation > 0:
        raise ShadowmapError(f"saturation: {saturation}, but must be positive; inf says that no pixel is saturated.")
    if longer_side < 1:
        raise ShadowmapError(f"longer_side: {longer_side}, but must be at least 1.")
    height, width = pixels.shape[:2]
    counts = None if mask is None else _mask(mask, (height, width), name)
    times = min(1.0, longer_side / max(height, width))
    to = max(1, round(height * times)), max(1, round(width * times))
    without: dict[str, int] = {}
    curve = None
    if pixels.dtype == np.float32:
        bright = fireflies(pixels)
        if bright.any():
            counts = np.where(bright, np.float32(0), np.float32(1) if counts is None else counts)
    else:
        most = np.iinfo(pixels.dtype).max
        curve = to_linear(np.arange(most + 1) / most).astype(np.float32)

    def rows(at: slice) -> Array:
        return _weighted(pixels[at], None if counts is None else counts[at], saturation, curve, without)

    image, weight = _divided(area_average(rows, (height, width), to))
    if not weight.any():
        found = ", ".join(
            f"{100 * count / (height * width):.0f} % of them are {what}" for what, count in without.items() if count
        )
        raise ShadowmapError(f"{name}: no pixel counts; {found}. Give another picture or mask (white counts).")
    target = Target(image, weight, sensor, name, exposure)
    if curve is not None or not (pixels[..., 3] < 1).any():
        return target
    colours = np.concatenate([pixels[..., :3], np.ones_like(pixels[..., :1])], axis=-1)
    return replace(target, opaque=_target(colours, mask, sensor, name, saturation, longer_side, exposure))


def _weighted(
    pixels: npt.NDArray[Any], counts: Array | None, saturation: float, curve: Array | None, without: dict[str, int]
) -> Array:
    """Linear colours times weights, and weights, (H, W, 4). Numbers of pixels without weight are added up by the reason."""
    if curve is None:
        finite = np.isfinite(pixels).all(-1)
        values = np.where(finite[..., None], pixels, np.float32(0))
        alpha = np.clip(values[..., 3], 0, 1)
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            straight = _largest(values) / alpha
        saturated = (straight >= saturation) & (alpha > 0)
        # Transparent pixels may shine, but do not count.
        colours = np.where(alpha[..., None] > 0, np.maximum(values[..., :3], 0), np.float32(0))
    else:
        most = np.float32(len(curve) - 1)
        finite = np.ones(pixels.shape[:2], bool)
        alpha = pixels[..., 3] / most
        saturated = _largest(pixels) >= saturation * most
        colours = curve[pixels[..., :3]] * alpha[..., None]
    factor = (finite & ~saturated).astype(np.float32)
    if counts is not None:
        factor *= counts
        without["masked"] = without.get("masked", 0) + int((counts == 0).sum())
    for what, lost in (("transparent", finite & (alpha == 0)), ("saturated", saturated), ("not finite", ~finite)):
        without[what] = without.get(what, 0) + int(lost.sum())
    return np.concatenate([colours * factor[..., None], (alpha * factor)[..., None]], axis=-1).astype(np.float32)


def _largest(pixels: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """The largest of red, green and blue."""
    return np.maximum(np.maximum(pixels[..., 0], pixels[..., 1]), pixels[..., 2])


def _divided(weighted: Array) -> tuple[Array, Array]:
    """Colours, and weights, of colours times weights beside weights."""
    weight = np.clip(weighted[..., 3], 0, 1)
    share = np.where(weight > 0, weight, 1)[..., None].astype(np.float64)
    image = np.where(weight[..., None] > 0, np.clip(weighted[..., :3] / share, 0, _MOST), 0)
    return image.astype(np.float32), weight


def _mask(mask: str | os.PathLike[str] | npt.ArrayLike, size: tuple[int, int], picture: str) -> Array:
    """A mask, from 0 to 1, in the size of a picture."""
    if isinstance(mask, (str, os.PathLike)):
        what, values = str(mask), _grey(read_pixels(mask))
    else:
        what, values = f"the mask of {picture}", _mask_values(mask, f"the mask of {picture}")
    if not is_same_shape(size, values.shape):
        raise ShadowmapError(
            f"{what} has {values.shape[1]} x {values.shape[0]} pixels, but {picture} has {size[1]} x {size[0]}, another aspect "
            "ratio: draw the mask over the whole picture."
        )
    if not values.any():
        raise ShadowmapError(f"{what} is black everywhere: paint white over the pixels that count.")
    return values if values.shape == size else area_average(lambda at: values[at, :, None], values.shape, size)[..., 0]


def _mask_values(mask: npt.ArrayLike, what: str) -> Array:
    values = _array(mask, what)
    if values.dtype.kind not in "buif":
        raise ShadowmapError(f"{what} is an array of {values.dtype}: give bool, integers, or floats in 0..1.")
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    if values.ndim != 2 or not values.size:
        raise ShadowmapError(f"{what} has the shape {values.shape}: give an array (H, W), not empty.")
    if values.dtype.kind in "ui":  # 0 and 1 also come as integers
        most = 1 if values.max() <= 1 else np.iinfo(values.dtype).max
        return np.clip(values.astype(np.float32) / np.float32(most), 0, 1)
    if values.dtype.kind == "f" and not (np.isfinite(values).all() and values.min() >= 0 and values.max() <= 1):
        raise ShadowmapError(f"{what} has numbers from {values.min():g} to {values.max():g}: give numbers in 0..1.")
    return values.astype(np.float32)


def _grey(pixels: npt.NDArray[Any]) -> Array:
    """Grey values (H, W) in 0..1 of a mask's pixels, over black. Those that are not finite are black: no such pixel counts."""
    if pixels.dtype == np.float32:
        counts = np.isfinite(pixels).all(-1) & (pixels[..., 3] > 0)
        colours = np.where(counts[..., None], pixels[..., :3], np.float32(0))
        return np.clip(colours.mean(-1, dtype=np.float64), 0, 1).astype(np.float32)
    most = np.float32(np.iinfo(pixels.dtype).max)
    return pixels[..., :3].mean(-1, dtype=np.float32) / most * (pixels[..., 3] / most)


def _array(value: Any, what: str) -> npt.NDArray[Any]:  # Any: see `make_target`
    try:
        detached = value.detach().cpu() if hasattr(value, "detach") and hasattr(value, "cpu") else value
        return np.asarray(detached.numpy() if hasattr(detached, "numpy") else detached)
    except Exception as error:  # of many kinds
        raise ShadowmapError(f"{what} is a {type(value).__name__}, of which NumPy makes no array: give one (H, W, 3).") from error


def _fitting_film(width: int, height: int, wanted_width: int, wanted_height: int) -> str:
    """Width and height of a film of the picture's aspect ratio, as large as the wanted one."""
    longer = max(wanted_width, wanted_height)
    scale = longer / max(width, height)
    return f"{max(1, round(width * scale))} x {max(1, round(height * scale))} pixels"

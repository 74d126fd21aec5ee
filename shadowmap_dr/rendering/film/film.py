"""Films: windows of samples, pictures made of samples, and Mitsuba's film that holds a picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from numbers import Real
from typing import cast

import drjit as dr
import mitsuba as mi

from ...errors import ShadowmapError, warn
from ...jit.arrays import backend
from ...jit.kernel_inputs import SharingOp, split, uint_input
from ...jit.types import Bool, Color3f, Float, TensorXf
from ...raster import MAX_RESOLUTION
from ...scene.sensor import ImageSize, Sensor
from .reconstruction import reconstruct

#: Most samples per pixel that may be asked for, as on the command line.
MOST_SAMPLES = 1 << 24


@dataclass(frozen=True)
class Margin:
    """Pixels of the film around a crop window. Anti-aliasing blends them with the outermost pixels of the window."""

    left: int = 0
    top: int = 0
    right: int = 0
    bottom: int = 0

    @classmethod
    def of(cls, cameras: Sequence[Sensor], factor: int) -> Margin:
        """One pixel on each side that lies in the film: pictures are the same whether cropped before or after.

        ``factor`` x ``factor`` samples a pixel; none where the rasterizer has no room for more.
        """
        (camera, *others), room = cameras, MAX_RESOLUTION // factor - 2
        if others or camera.border > 0 or max(camera.width, camera.height) > room:
            return cls()
        film, (x, y) = camera.film_size, camera.crop_offset
        return cls(int(x > 0), int(y > 0), int(x + camera.width < film.width), int(y + camera.height < film.height))

    def around(self, camera: Sensor) -> Sensor:
        """A camera whose window includes the margin."""
        x, y = camera.crop_offset
        size = ImageSize(camera.width + self.left + self.right, camera.height + self.top + self.bottom)
        return replace(camera, crop_size=size, crop_offset=(x - self.left, y - self.top))

    def cut(self, picture: TensorXf, factor: int) -> TensorXf:
        """A picture (rows, columns, C) of ``factor`` x ``factor`` samples a pixel without the margin."""
        if self == Margin():
            return picture
        rows, columns = picture.shape[:2]
        first, last = (self.top * factor, self.left * factor), (rows - self.bottom * factor, columns - self.right * factor)
        return picture[first[0] : last[0], first[1] : last[1]]


def sample_windows(cameras: Sequence[Sensor]) -> tuple[Sensor, ...]:
    """Cameras whose windows include the samples beyond the film's border (``sample_border``).

    Cameras of one film lie side by side: the first one gets a border on its left, the last one on its right.
    """
    border = cameras[0].border
    if border == 0:
        return _checked(tuple(cameras))
    windows = []
    for k, camera in enumerate(cameras):
        left, right = border * (k == 0), border * (k == len(cameras) - 1)
        x, y = camera.crop_offset
        size = ImageSize(camera.width + left + right, camera.height + 2 * border)
        windows.append(replace(camera, crop_size=size, crop_offset=(x - left, y - border)))
    return _checked(tuple(windows))


def _checked(windows: tuple[Sensor, ...]) -> tuple[Sensor, ...]:
    for window in windows:
        if max(window.width, window.height) > MAX_RESOLUTION:
            size = f"A picture of {window.width} x {window.height} pixels"
            raise ShadowmapError(f"{size} is too large: render it in crop windows of {MAX_RESOLUTION} pixels a side at most.")
    return windows


def check_samples(spp: float) -> None:
    """ShadowmapError unless ``spp`` is a number of samples per pixel."""
    if isinstance(spp, bool) or not isinstance(spp, Real) or not spp >= 1:
        raise ShadowmapError(f"spp is {spp!r}: give at least 1 sample per pixel.")
    if spp > MOST_SAMPLES:
        raise ShadowmapError(f"spp is {spp!r}: give at most {MOST_SAMPLES} samples per pixel; no more than 256 are taken.")


def sample_grid(spp: float, windows: Sequence[Sensor]) -> int:
    """Samples along each side of a pixel: at most 16, and as many as the rasterizer's largest image has room for.

    A warning names both counts where fewer samples are taken than were asked for.
    """
    check_samples(spp)
    widest = max(windows, key=lambda window: max(window.width, window.height))
    wanted = min(math.isqrt(math.ceil(spp) - 1) + 1, 16)
    factor = max(1, min(wanted, MAX_RESOLUTION // max(widest.width, widest.height)))
    if factor < wanted:
        size = f"{widest.width} x {widest.height} pixels"
        warn(
            f"Of {wanted**2} samples per pixel {factor**2} are taken: {size} would be more than {MAX_RESOLUTION} samples "
            "along a side. Render parts of the image with crop windows, or lower spp."
        )
    return factor


def develop(pictures: Sequence[TensorXf], camera: Sensor, factor: int) -> TensorXf:
    """Picture (``mi.TensorXf``, H, W, C) of the samples that the cameras of one film took.

    Args:
        pictures: for each camera's window (:func:`sample_windows`) a tensor (rows, columns, C) of ``factor`` x ``factor`` samples
            for each pixel; side by side they are the film.
        camera: any of these cameras.

    The film's colours and alpha pass through its reconstruction filter, further channels are means over the samples in a pixel.
    Gradients flow to ``pictures``.
    """
    if camera.filter.is_box:
        return _side_by_side([_means(picture, factor) for picture in pictures])
    samples = _side_by_side(pictures)
    filtered = camera.channels + camera.alpha
    if samples.shape[2] == filtered:
        return reconstruct(samples, camera.filter, factor, camera.border)
    edge = camera.border * factor
    inner = samples[edge : samples.shape[0] - edge, edge : samples.shape[1] - edge, filtered:]
    image = reconstruct(samples[:, :, :filtered], camera.filter, factor, camera.border)
    return dr.concat([image, _means(inner, factor)], axis=2)


def _side_by_side(images: Sequence[TensorXf]) -> TensorXf:
    return images[0] if len(images) == 1 else dr.concat(list(images), axis=1)


def _means(image: TensorXf, factor: int) -> TensorXf:
    """Average factor x factor blocks."""
    if factor == 1:
        return image
    height, width, channels = image.shape[0] // factor, image.shape[1] // factor, image.shape[2]
    return mi.TensorXf(dr.custom(_Means, image.array, height, width, channels, factor), shape=(height, width, channels))


class _Means(SharingOp):
    """Means over blocks of samples. The adjoint of Dr.Jit's own gathers would add to zeros, with a copy for each thread."""

    def eval(self, samples: Float, height: int, width: int, channels: int, factor: int) -> Float:
        self._shape = height, width, channels, factor
        found = self._mean(samples)
        dr.eval(found)  # a loss and its derivative read them
        return found

    def forward(self) -> None:
        self.set_grad_out(self._mean(cast("Float", self.grad_in("samples"))))

    def backward(self) -> None:
        gradient = cast("Float", self.grad_out())
        height, width, channels, factor = self._shape
        module = backend(gradient)
        index = dr.arange(module.UInt32, height * width * channels * factor**2)
        sample, channel = split(index, "channels", channels, height * width * factor**2)
        row, column = split(sample, "samples of a row", width * factor, height * factor)
        pixel = (row // factor) * uint_input(module, "width", width) + column // factor
        self.set_grad_in("samples", dr.gather(module.Float, gradient, pixel * channels + channel) * (1 / factor**2))

    def name(self) -> str:
        return "means over samples"

    def _mean(self, samples: Float) -> Float:
        height, width, channels, factor = self._shape
        module = backend(samples)
        index = dr.arange(module.UInt32, height * width * channels)
        pixel, channel = index // channels, index % channels
        row, column = split(pixel, "width", width, height)
        columns = uint_input(module, "width", width * factor)
        total = dr.zeros(module.Float, height * width * channels)
        for j in range(factor):
            for i in range(factor):
                source = ((row * factor + j) * columns + column * factor + i) * channels + channel
                total += dr.gather(module.Float, samples, source)
        return total * (1 / factor**2)


def put_into_film(film: mi.Film, image: TensorXf, aovs: list[str]) -> None:
    """Make ``film.develop()``, ``film.bitmap()`` and ``film.write()`` give this image (detached).

    Nothing is copied until one of them is called: most loops call none.
    """
    film.prepare(aovs)
    base = film.base_channels_count()
    alpha = base in (2, 4)
    height, width, channels = image.shape
    # A film stores three colours, even if it is to give luminance, then alpha, then the weight that it divides by.
    weight = 3 + alpha
    count = weight + 1 + channels - base
    number = dr.arange(mi.UInt32, height * width * count)
    pixel = number // count
    place = number - pixel * count
    source = dr.select(place > weight, place - (weight + 1) + base, place if base - alpha == 3 else mi.UInt32(0))
    if alpha:
        source = dr.select(place == 3, base - 1, source)
    is_weight = place == weight
    values = dr.select(is_weight, 1, dr.gather(mi.Float, dr.detach(image).array, pixel * channels + source, ~is_weight))
    stored = mi.TensorXf(values, shape=(height, width, count))
    film.put_block(mi.ImageBlock(stored, offset=film.crop_offset(), rfilter=None, border=False))


def film_channels(color: Color3f, coverage: Bool | Float, sensor: Sensor) -> list[Float]:
    """Channels (Float) of a colour in a sensor's film: one or three, and coverage if the film has alpha."""
    channels = [color[k] for k in range(len(color))]
    if sensor.channels == 1 and len(channels) == 3:
        channels = [mi.luminance(color)]
    elif sensor.channels == 3 and len(channels) == 1:
        channels = channels * 3
    if sensor.alpha:
        channels.append(mi.Float(coverage))
    return channels

"""Linear images of a fit as 8-bit pictures: colours, signed differences, weights; and errors in words."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from ..io.animations import Pixels
from ..io.images import to_srgb
from ..io.plot_style import SIGNED
from .result import Image, Picture, brightness

# Share of counted pixels, in percent, within the scale of a difference and within the brightness of a display.
_MOST = 99.0
# Brightness of nearly all pixels of targets that are displayed as they are.
_DARK, _BRIGHT = 0.2, 1.6
# Round numbers for the ends of scales, from 1 to 10.
_ENDS = (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10)
# Greys of the stripes of pixels that do not count, and the stripes' width in pixels.
_STRIPES, _STRIPE = ((148, 148, 148), (120, 120, 120)), 4


def gain(picture: Picture) -> float:
    """Factor for the display of all images of a target: 1, unless the target would be nearly black or white."""
    counted = np.nan_to_num(picture.target)[picture.weight > 0]
    level = float(np.percentile(counted, _MOST)) if counted.size else 1.0
    return 1.0 if _DARK <= level <= _BRIGHT or not level > 0 else 1.0 / level


def colours(image: Image, factor: float = 1.0) -> Pixels:
    """A linear image (H, W, C), C of at least 3, as sRGB (H, W, 3)."""
    with np.errstate(over="ignore"):
        linear = np.nan_to_num(image[..., :3] * np.float32(factor))
    return _bytes(to_srgb(linear))


def greys(fraction: Image) -> Pixels:
    """Numbers of 0 to 1, (H, W), as (H, W, 3): 0 is black and 1 is white."""
    return np.repeat(_bytes(np.clip(np.nan_to_num(fraction), 0, 1))[..., None], 3, axis=2)


def difference(image: Image, target: Image, weight: Image) -> npt.NDArray[np.float64]:
    """Image minus target, mean over the channels, as a fraction of the target's brightness (weighted RMS): (H, W)."""
    scale = brightness(target, weight)
    scale = scale if math.isfinite(scale) and scale > 0 else 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        sums = (image[..., :3] - target[..., :3]) @ np.full(3, 1 / (3 * scale))
    return np.nan_to_num(sums)


def limit(values: npt.NDArray[np.float64], weight: Image) -> float:
    """End of the scale of a difference: nearly all counted magnitudes lie below it. A round number."""
    counted = np.abs(values[weight > 0])
    found = float(np.percentile(counted, _MOST)) if counted.size else 0.0
    found = found or float(counted.max(initial=0.0))
    if not 1e-6 < found:
        return 1e-6 if found else 0.01
    unit = 10.0 ** math.floor(math.log10(found))
    return next(end for end in _ENDS if found / unit <= end + 1e-9) * unit


def difference_colours(values: npt.NDArray[np.float64], weight: Image, end: float, size: tuple[int, int] | None = None) -> Pixels:
    """A difference in colours: blue where the image is darker, red where it is brighter, grey stripes for pixels without weight.

    ``size``: height and width of the result, None for that of the difference.
    """
    from matplotlib import colormaps

    height, width = size or values.shape
    colour = colormaps[SIGNED](0.5 + 0.5 * np.clip(values / end, -1, 1), bytes=True)[..., :3]
    pixels = np.array(resized(colour, height, width))
    masked = resized(np.where(weight <= 0, 255, 0).astype(np.uint8), height, width)
    y, x = np.nonzero(masked > 127)
    pixels[y, x] = np.array(_STRIPES, np.uint8)[(x + y) // _STRIPE % 2]
    return pixels


def scale_colours(count: int = 9) -> list[str]:
    """Colours of the scale of differences from its lower to its upper end, "#rrggbb"."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    return [to_hex(colormaps[SIGNED](k / (count - 1))) for k in range(count)]


def averaged(image: Image, height: int, width: int) -> Image:
    """An image (H, W, C) or (H, W), reduced to a smaller size by averages over areas."""
    from PIL import Image as pillow

    planes = np.nan_to_num(np.atleast_3d(np.asarray(image, np.float32)))
    small = [
        np.asarray(pillow.fromarray(np.ascontiguousarray(planes[..., k])).resize((width, height), pillow.Resampling.BOX))
        for k in range(planes.shape[2])
    ]
    return np.stack(small, axis=2) if image.ndim == 3 else small[0]


def resized(pixels: Pixels, height: int, width: int) -> Pixels:
    """Pixels (H, W, 3) or (H, W) in another size: enlarged ones stay squares, reduced ones are averages."""
    from PIL import Image as pillow

    smaller = height < pixels.shape[0] or width < pixels.shape[1]
    method = pillow.Resampling.BOX if smaller else pillow.Resampling.NEAREST
    return np.asarray(pillow.fromarray(pixels).resize((width, height), method))


def percent(fraction: float) -> str:
    """A fraction with two significant digits, which no line break parts from its sign: "12 %", "0.34 %"."""
    return _percent(fraction).replace(" %", "\u00a0%")


def _percent(fraction: float) -> str:
    if not math.isfinite(fraction):
        return "unknown" if math.isnan(fraction) else "more than 1000 %"
    number = 100 * fraction
    if abs(number) > 1000:
        return f"{'more' if number > 0 else 'less'} than {math.copysign(1000, number):.0f} %"
    if abs(number) < 0.001:
        return "0 %" if number == 0 else "less than 0.001 %"
    places = max(0, 1 - math.floor(math.log10(abs(number))))
    text = f"{number:.{places}f}"
    return f"{text.rstrip('0').rstrip('.') if '.' in text else text} %"


def error_words(error: float) -> str:
    """An error as words: "differs from the target by 12 % of its brightness"."""
    return f"differs from the target by {percent(error)} of its brightness"


def _bytes(values: npt.NDArray[np.floating]) -> Pixels:
    return np.round(255 * values).astype(np.uint8)

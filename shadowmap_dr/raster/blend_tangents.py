"""Mixing of pixels together with the derivatives of all that is mixed, by the few parameters on which a batch depends."""

from __future__ import annotations

from typing import Any

import drjit as dr

from .blend import Mixer


def mixed_tangents(mixer: Mixer, tangents: Any, right: Any, down: Any) -> Any:
    """Derivatives of a mixer's values by P parameters.

    Args:
        mixer: has C channels, flat and interleaved.
        tangents: flat ``Float``, P * C for each pixel: derivatives of the original values, parameter by parameter.
        right, down: flat ``Float``, P for each pixel: derivatives of the weights of its pairs with the right and with the lower
            neighbour; may be undefined where that weight is 0.

    Returns:
        Like ``tangents``, of the mixed values.
    """
    module = mixer.module
    Float, channels = module.Float, mixer.channels
    count = dr.width(right) // mixer.pixels
    pixel = dr.arange(module.UInt32, mixer.pixels)
    incoming = mixer.around(mixer.crossings.right, mixer.crossings.down, 1)
    own = _read(module, tangents, pixel, count * channels)

    def mix(pixel: Any, *lanes: Any) -> tuple[Any, ...]:
        incoming, own = lanes[:4], lanes[4:]
        claims = sum(incoming)
        scale = dr.rcp(dr.maximum(1, claims))
        here = mixer.read(mixer.original, pixel)
        # A pixel that is wholly claimed shares itself out: more for one neighbour is less for all of them.
        mean = [dr.select(claims >= 1, m, h) for m, h in zip(mixer.read(mixer.values, pixel), here, strict=True)]
        total = list(own)
        # Who holds the weight, and the sign with which it says that the neighbour reaches into the pixel.
        holders = ((right, pixel, -1), (down, pixel, -1), (right, pixel - 1, 1), (down, pixel - mixer.width, 1))
        for weight, neighbour, (rates, holder, sign) in zip(incoming, mixer.neighbours(pixel), holders, strict=True):
            active = weight > 0
            values = mixer.read(mixer.original, neighbour, active)
            change = _read(module, tangents, neighbour, count * channels, active)
            factor = weight * scale
            for p, rate in enumerate(_read(module, rates, holder, count, active)):
                rate = dr.select(active, sign * rate * scale, 0)
                for c in range(channels):
                    k = p * channels + c
                    # Not in place, which would change what is the pixel's own, too.
                    total[k] = total[k] + dr.select(active, factor * (change[k] - own[k]) + rate * (values[c] - mean[c]), 0)
        return tuple(total)

    mixed = mixer.where(sum(incoming) > 0, mix, pixel, (*incoming, *own), own)
    if len(mixed) == 4:
        return dr.ravel(module.Array4f(*mixed))
    result = dr.empty(Float, dr.width(tangents))
    dr.scatter(result, module.ArrayXf(mixed), pixel)
    return result


def _read(module: Any, flat: Any, pixel: Any, count: int, active: Any = True) -> list[Any]:
    """``count`` numbers of pixels, in packets as large as there are."""
    size = next(n for n in (4, 2, 1) if count % n == 0)
    if size == 1:
        return [dr.gather(module.Float, flat, pixel * count + k, active) for k in range(count)]
    packet = {2: module.Array2f, 4: module.Array4f}[size]
    parts = count // size
    return [number for k in range(parts) for number in dr.gather(packet, flat, pixel * parts + k, active)]

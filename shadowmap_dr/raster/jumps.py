"""How much colours jump at an edge between two pixels, from what is seen on both sides of it.

The colours at the pixels' centres differ by more than that: what shading falls by on the way to a rim, say, is no jump, and would
count twice where the rim moves. So both sides are continued to the edge, as steeply as they change beyond the pixels. The weights
of pixels that are mixed do not depend on it, but the derivatives of what is mixed do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from ._types import NO_TRIANGLE, backend


@dataclass(frozen=True)
class Surroundings:
    """What it takes to tell whether colours change steadily from a pixel to its neighbour. Detached.

    Attributes:
        triangle: ``UInt32``, what each pixel sees.
        parts: ``UInt32`` (F,), see :class:`Topology`.
        creases: ``Bool`` (3 F,), edges of faces at which colours jump, or None.
        height, width: of an image.
        sharpness: ``Float`` for each pixel, 1 where a flat face is large enough for its own colour to be seen, or None for 1.
            Between small ones, whose colours are at random where pixels see them, there is nothing to continue.
    """

    triangle: Any
    parts: Any
    creases: Any
    height: int
    width: int
    sharpness: Any

    def beyond(
        self,
        read: Callable[[Any, Any], list[Any]],
        crossed: Callable[[Any, Any, Any], Any],
        taker: Any,
        giver: Any,
        down: Any,
        place: Any,
        active: Any = True,
    ) -> list[Any]:
        """Colours of pixels, plus how much those of their neighbours differ from them at an edge in between.

        Both are continued up to the edge, if the next pixel on their other side sees the same surface. The difference has the
        sign of that between the pixels, and is at most twice as large, in each channel.

        Args:
            read: ``read(pixel, active)``, the channels of pixels.
            crossed: ``crossed(pixel, down, active)``, whether an edge lies between a pixel and its right (lower) neighbour.
            taker, giver: pixels, and neighbours that reach into them.
            down: whether these are above or below.
            place: of the edge, from 0 at the taker's centre to 1 at the giver's.
        """
        module = backend(place)
        own, other = read(taker, active), read(giver, active)
        step = dr.select(down, module.UInt32(self.width), 1)
        forward = giver > taker
        slopes = []
        for near, values, sign in ((taker, own, -1), (giver, other, 1)):
            ahead = forward if sign > 0 else ~forward
            far = dr.select(ahead, near + step, near - step)
            steady, smooth = self._steady(near, far, self._inside(near, down, ahead, active))
            steady |= smooth & ~crossed(dr.select(ahead, near, far), down, smooth)
            slopes.append([dr.select(steady, sign * (f - v), 0) for f, v in zip(read(far, steady), values, strict=True)])
        result = []
        for o, v, slope, other_slope in zip(own, other, *slopes, strict=True):
            jump = v - o
            continued = dr.fma(other_slope, place - 1, dr.fma(-slope, place, jump))
            result.append(o + dr.clip(continued, dr.minimum(2 * jump, 0), dr.maximum(2 * jump, 0)))
        return result

    def _inside(self, pixel: Any, down: Any, ahead: Any, active: Any) -> Any:
        """Whether the next pixel to the right (left, if not ``ahead``) or below (above) belongs to the same image."""
        UInt32 = backend(pixel).UInt32
        row_flat = pixel // self.width
        at = dr.select(down, row_flat % self.height, pixel - row_flat * self.width)
        last = dr.select(down, UInt32(self.height), self.width) - 1
        return dr.select(ahead, at < last, at > 0) & active

    def _steady(self, near: Any, far: Any, inside: Any) -> tuple[Any, Any]:
        """Whether pixels and their neighbours see the same triangle, and whether they see others of a smooth surface.

        These may still have an edge in between. That no edge crosses the way to the neighbour would not be enough by itself:
        edges along it do not count there.
        """
        module = backend(near)
        here, there = (dr.gather(module.UInt32, self.triangle, pixel, inside) for pixel in (near, far))
        inside = inside & (here != NO_TRIANGLE) & (there != NO_TRIANGLE)
        same, smooth = inside & (here == there), inside & (here != there)
        if self.sharpness is not None:
            same &= dr.gather(module.Float, self.sharpness, near, same) == 1
        if self.creases is not None:
            for k in range(3):
                smooth &= ~dr.gather(module.Bool, self.creases, 3 * here + k, smooth)
        part, other = (dr.gather(module.UInt32, self.parts, triangle, smooth) for triangle in (here, there))
        smooth &= part == other
        return same, smooth

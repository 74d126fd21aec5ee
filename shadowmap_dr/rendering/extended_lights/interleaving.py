"""Interleaved sampling: each of many samples of a pixel sees some points of an area light, all together see all of them.

Source: Keller and Heidrich, "Interleaved Sampling", 2001.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ...jit.types import UInt32
from ...raster.types import by_pixel
from ...scene.sensor import ImageSize

# Each point of a light is seen by at least so many samples along each side of a pixel, and each sample sees so many points.
_SAMPLES, _POINTS = 4, 4


@dataclass(frozen=True)
class Interleaving:
    """Groups of samples that see the same points of a light of N points, as many points in each group.

    A sample of group g sees the points g, g + K, g + 2 K, ... for K groups. Neighbouring samples are in different groups, and
    the samples of a group are spread evenly over the pixel, so that the mean over a pixel is that over all points.

    Attributes:
        points: N.
        groups: K; 1 if each sample sees all points.
        group: ``UInt32`` (P,), the group of each sample; None for one group.
    """

    points: int
    groups: int = 1
    group: UInt32 | None = None

    @classmethod
    def of(cls, points: int, size: ImageSize, factor: int, images: int = 1) -> Interleaving:
        """Choose the groups. ``size``: samples of each of some images; ``factor``: samples along each side of a pixel."""
        sides = [n for n in range(1, factor // _SAMPLES + 1) if factor % n == points % (n * n) == 0 and points >= _POINTS * n * n]
        side = max(sides, default=1)
        if side == 1:
            return cls(points)
        lane = dr.arange(mi.UInt32, images * size.width * size.height)
        _, row, column = by_pixel(lane, images, size.height, size.width)
        return cls(points, side * side, column % side + row % side * side)

    @property
    def seen(self) -> int:
        """Number of points that a sample sees."""
        return self.points // self.groups

    def point(self, number: UInt32, group: UInt32 | None) -> UInt32:
        """The point (UInt32) that samples of a group see as number ``number`` (UInt32) of theirs."""
        return number if group is None else number * self.groups + group

"""Translucent surfaces before those of a raster, and the lines along which these two intersect."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr

from ...jit.arrays import backend
from ...jit.types import Bool, UInt32


@dataclass(frozen=True)
class FrontSurfaces:
    """Translucent surfaces before the surfaces of a raster, for each of its N pixels. Detached.

    Where such a surface goes behind an opaque one, the raster shows the same opaque surface on both sides of the line.

    Attributes:
        count: ``UInt32`` (N,), their number.
        last: ``UInt32`` (N,), triangle of the one next to the raster's surface, ``NO_TRIANGLE`` where there is none.
    """

    count: UInt32
    last: UInt32

    def differ(self, pixel: UInt32, other: UInt32, active: Bool) -> Bool:
        """True if one of two pixels has one surface more than the other."""
        one, two = (dr.gather(backend(pixel).UInt32, self.count, p, active) for p in (pixel, other))
        return active & ((one == two + 1) | (two == one + 1))

    def triangles(self, pixel: UInt32, other: UInt32, here: UInt32, there: UInt32, active: Bool) -> tuple[UInt32, UInt32]:
        """Triangles of two pixels that :meth:`differ`: the last front surface of the one that has more, and the raster's.

        ``here``, ``there``: triangles of the raster.
        """
        kind = backend(pixel).UInt32
        first = dr.gather(kind, self.count, pixel, active) > dr.gather(kind, self.count, other, active)
        last = dr.gather(kind, self.last, dr.select(first, pixel, other), active)
        return dr.select(first, last, here), dr.select(first, there, last)

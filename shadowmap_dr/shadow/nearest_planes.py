"""Planes that fit points in light space best."""

from __future__ import annotations

import drjit as dr

from ..jit.arrays import backend
from ..jit.types import Bool, Float, UInt32
from .grouped import grouped_sums, numbers_of

# Least variance across the light, a share of that along it, that the slope of a plane is fitted to.
_RIDGE = 1e-3


def nearest_planes(points: tuple[Float, Float, Float], group: UInt32, count: int, active: Bool) -> tuple[Float, Float, Float]:
    """(a, b, c), (count,) each, of the planes z = a x + b y + c with the least squared distances along z. Detached.

    Args:
        points: (x, y, z) in light space.
        group: plane of each point, below ``count``.
        active: mask of the points that count. Without any, a plane is z = 0.
    """
    module = backend(points[0])
    row = dr.arange(module.UInt32, count)

    def sums(values: list[Float]) -> list[Float]:
        """Sums over the points of each group."""
        return numbers_of(grouped_sums(values, group, count, active), row, len(values))

    with dr.suspend_grad():
        number, *totals = sums([module.Float(1), *points])
        number = dr.maximum(number, 1)
        middle = [total / number for total in totals]
        dr.eval(middle)
        x, y, z = (value - dr.gather(module.Float, mean, group) for value, mean in zip(points, middle, strict=True))
        xx, xy, yy, xz, yz, zz = (total / number for total in sums([x * x, x * y, y * y, x * z, y * z, z * z]))
        xx, yy = xx + _RIDGE * zz, yy + _RIDGE * zz
        determinant = xx * yy - xy * xy
        # Points on a line along the light, or at one place, determine no slope.
        inverse = dr.select(determinant > 0, dr.rcp(determinant), 0)
        a, b = (xz * yy - yz * xy) * inverse, (yz * xx - xz * xy) * inverse
        c = middle[2] - a * middle[0] - b * middle[1]
        dr.eval(a, b, c)
        return a, b, c

"""Mitsuba's transformations: which objects are some, and their parts."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..jit.types import Point3f, Vector3f


def is_transform(value: object) -> bool:
    """True for transformations of all of Mitsuba's types, scalar or not; ``value`` may be a type as well.

    Dr.Jit's vectors have a ``matrix``, too: all names that end in x, y or z name components of theirs (``docs/dr-jit-faults``).
    """
    return not dr.is_array_v(value) and hasattr(value, "matrix")


def translation(to_world: mi.Transform4f) -> Point3f:
    """Image of the origin (``mi.Point3f``) under a ``mi.Transform4f``. Attached."""
    matrix = to_world.matrix
    return mi.Point3f(matrix[0, 3], matrix[1, 3], matrix[2, 3])


def axis(to_world: mi.Transform4f, k: int) -> Vector3f:
    """Image of the k-th axis (``mi.Vector3f``, with its scale) under a ``mi.Transform4f``. Attached."""
    matrix = to_world.matrix
    return mi.Vector3f(matrix[0, k], matrix[1, k], matrix[2, k])

"""Unit vectors with finite derivatives, and means of components."""

from __future__ import annotations

from typing import cast

import drjit as dr

from .arrays import backend, reinterpret
from .types import Bool, Color3f, Float, Vector3f

#: Vectors whose components are all below this count as zero where zero is a case of its own.
LEAST = 2.0**-100


def unit(vector: Vector3f) -> Vector3f:
    """Unit vector along a vector that is not 0, even where squares of its components overflow or underflow. Attached."""
    scaled, _, _ = _near_one(vector)
    return dr.normalize(scaled)


def normalize_or(vector: Vector3f, fallback: Vector3f) -> Vector3f:
    """Unit vector, or ``fallback`` where no component reaches ``LEAST``. Neither value nor gradient is NaN. Attached to both."""
    scaled, _, there = _near_one(vector)
    return dr.select(there, scaled * dr.rsqrt(dr.select(there, dr.squared_norm(scaled), 1.0)), fallback)


def direction_and_length(vector: Vector3f) -> tuple[Vector3f, Float, Bool]:
    """(unit vector, length, whether there is one), for vectors of any size. Attached.

    Where no component reaches ``LEAST``, all three are zero.
    """
    scaled, scale, there = _near_one(vector)
    squared = dr.select(there, dr.squared_norm(scaled), 1.0)
    inverse = dr.rsqrt(squared)
    return dr.select(there, scaled * inverse, 0), dr.select(there, squared * inverse * dr.rcp(scale), 0), there


def _near_one(vector: Vector3f) -> tuple[Vector3f, Float, Bool]:
    """(the vector times a power of two that brings its largest component near 1, that power, whether one reaches ``LEAST``).

    The product rounds nothing. Without it, the derivative of the direction of a vector of length 1e-13 overflows: it holds the
    inverse of the length's third power.
    """
    largest = dr.max(dr.abs(dr.detach(vector)))
    module = backend(largest)
    # At most 1 / LEAST, so that derivatives do not overflow where vectors vanish.
    exponent = dr.clip(reinterpret(module.UInt32, largest) & 0x7F800000, (127 - 100) << 23, 0x7E800000)
    scale = reinterpret(module.Float, 0x7F000000 - exponent)
    return vector * scale, scale, largest > LEAST


def mean_of(value: Float | Color3f) -> Float:
    """Mean of the components of a colour, or the number itself. Attached."""
    return cast("Float", dr.mean(value) if dr.depth_v(value) > 1 else value)

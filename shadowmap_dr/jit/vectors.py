"""Unit vectors with finite derivatives."""

from __future__ import annotations

import drjit as dr

from .arrays import backend, reinterpret
from .types import Vector3f


def unit(vector: Vector3f) -> Vector3f:
    """Unit vector along a vector that is not 0, even where squares of its components overflow or underflow. Attached."""
    largest = dr.max(dr.abs(dr.detach(vector)))
    # Scale by the power of two that brings the largest component near 1: this rounds nothing.
    module = backend(largest)
    exponent = dr.minimum(reinterpret(module.UInt32, largest) & 0x7F800000, 0x7E800000)
    scale = reinterpret(module.Float, 0x7F000000 - exponent)
    return dr.normalize(vector * scale)


def normalize_or(vector: Vector3f, fallback: Vector3f) -> Vector3f:
    """Unit vector, or ``fallback`` where the vector is zero. Neither value nor gradient is NaN there. Attached to both."""
    squared = dr.squared_norm(vector)
    valid = squared > 0
    return dr.select(valid, vector * dr.rsqrt(dr.select(valid, squared, 1.0)), fallback)

"""Unit vectors with finite derivatives."""

from __future__ import annotations

from typing import Any

import drjit as dr

from .arrays import backend


def unit(vector: Any) -> Any:
    """A vector (``Array3f`` or the like, any length but 0) made unit, attached. Its components' squares may be out of range."""
    largest = dr.max(dr.abs(dr.detach(vector)))
    # The power of two that makes it about 1, made of the exponent's bits: multiplying by it changes no digit.
    module = backend(largest)
    exponent = dr.minimum(dr.reinterpret_array(module.UInt32, largest) & 0x7F800000, 0x7E800000)
    scale = dr.reinterpret_array(module.Float, 0x7F000000 - exponent)
    return dr.normalize(vector * scale)


def normalize_or(vector: Any, fallback: Any) -> Any:
    """Unit vector, or ``fallback`` where the vector is zero. Neither its value nor its gradient is ever NaN there."""
    squared = dr.squared_norm(vector)
    valid = squared > 0
    return dr.select(valid, vector * dr.rsqrt(dr.select(valid, squared, 1.0)), fallback)

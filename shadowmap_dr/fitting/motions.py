"""Rotations and affine maps of few attached numbers."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ..jit.types import Float, Matrix4f, Vector3f

Array = npt.NDArray[np.float64]


def rotation(vector: Vector3f) -> Matrix4f:
    """Rotation about an axis: ``vector`` (Vector3f) is the axis times the angle in radians. Attached, also at zero."""
    # Never zero, so that its derivative is finite.
    angle = dr.sqrt(dr.squared_norm(vector) + 1e-20)
    # (1 - cos) / angle^2 by the half angle: differences from one would lose all digits of small angles.
    half = dr.sin(0.5 * angle) / (0.5 * angle)
    s, c = dr.sin(angle) / angle, 0.5 * half * half
    x, y, z = vector.x, vector.y, vector.z
    return mi.Matrix4f(
        [1 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y, 0],
        [c * x * y + s * z, 1 - c * (x * x + z * z), c * y * z - s * x, 0],
        [c * x * z - s * y, c * y * z + s * x, 1 - c * (x * x + y * y), 0],
        [0, 0, 0, 1],
    )


def translation(offset: Vector3f) -> Matrix4f:
    """Translation by an offset (Vector3f). Attached."""
    return mi.Matrix4f([1, 0, 0, offset.x], [0, 1, 0, offset.y], [0, 0, 1, offset.z], [0, 0, 0, 1])


def scaling(factor: Float) -> Matrix4f:
    """Scale by a factor (Float) about the origin. Attached."""
    return mi.Matrix4f([factor, 0, 0, 0], [0, factor, 0, 0], [0, 0, factor, 0], [0, 0, 0, 1])


def host_matrix(matrix: Matrix4f | mi.Transform4f) -> Array:
    """A matrix or transformation as (4, 4)."""
    value = dr.detach(mi.Matrix4f(getattr(matrix, "matrix", matrix)))
    return np.array(value, np.float64).reshape(4, 4, -1)[..., 0]


def tangents(direction: npt.ArrayLike) -> tuple[Array, Array]:
    """Two unit vectors (3,) that are perpendicular to a direction (3,) and to each other."""
    d = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    first = np.cross(d, np.eye(3)[np.abs(d).argmin()])
    first /= np.linalg.norm(first)
    return first, np.cross(d, first)

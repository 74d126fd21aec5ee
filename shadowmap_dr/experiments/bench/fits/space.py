"""Affine maps (4, 4) and rotations, in NumPy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def rotation(vector: npt.ArrayLike) -> Array:
    """(3, 3) rotation about the direction of a vector, by its length in radians (Rodrigues)."""
    vector = np.asarray(vector, float)
    angle = float(np.linalg.norm(vector))
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def rotation_vector(matrix: Array) -> Array:
    """Vector (3,) of which `rotation` makes a rotation (3, 3)."""
    # The axis is the eigenvector of the quaternion's matrix, which is exact for small and for large angles.
    m = matrix
    k = np.array(
        [
            [m[0, 0] - m[1, 1] - m[2, 2], m[1, 0] + m[0, 1], m[2, 0] + m[0, 2], m[2, 1] - m[1, 2]],
            [m[1, 0] + m[0, 1], m[1, 1] - m[0, 0] - m[2, 2], m[2, 1] + m[1, 2], m[0, 2] - m[2, 0]],
            [m[2, 0] + m[0, 2], m[2, 1] + m[1, 2], m[2, 2] - m[0, 0] - m[1, 1], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], m[0, 0] + m[1, 1] + m[2, 2]],
        ]
    )
    x, y, z, w = np.linalg.eigh(k)[1][:, -1]
    axis = np.array([x, y, z]) * (1 if w >= 0 else -1)
    length = float(np.linalg.norm(axis))
    return axis * (2 * np.arctan2(length, abs(w)) / length) if length else np.zeros(3)


def nearest_rotation(linear: Array) -> Array:
    """The rotation nearest to a (3, 3) matrix: without its scale and its rounding."""
    u, _, v = np.linalg.svd(linear)
    return u @ np.diag([1, 1, np.sign(np.linalg.det(u @ v))]) @ v


def moved(linear: npt.ArrayLike, translation: npt.ArrayLike = (0, 0, 0), about: npt.ArrayLike = (0, 0, 0)) -> Array:
    """(4, 4) map: a linear one about a point, and then a translation."""
    result = np.eye(4)
    result[:3, :3] = linear
    result[:3, 3] = np.asarray(about) - result[:3, :3] @ np.asarray(about) + np.asarray(translation)
    return result


def applied(matrix: Array, points: npt.ArrayLike) -> Array:
    """Points (..., 3) under a map (4, 4)."""
    return np.asarray(points, float) @ matrix[:3, :3].T + matrix[:3, 3]


def look_at(origin: npt.ArrayLike, target: npt.ArrayLike, up: npt.ArrayLike = (0, 1, 0)) -> Array:
    """(4, 4) place of a camera or a spot that looks along its z axis, x to the left: as Mitsuba's."""
    ahead = unit(np.subtract(target, origin))
    left = unit(np.cross(np.asarray(up, float), ahead))
    result = np.eye(4)
    result[:3] = np.column_stack([left, np.cross(ahead, left), ahead, np.asarray(origin, float)])
    return result


def unit(vector: npt.ArrayLike) -> Array:
    """A vector of length 1."""
    vector = np.asarray(vector, float)
    return vector / np.linalg.norm(vector)


def angle_deg(one: npt.ArrayLike, other: npt.ArrayLike) -> float:
    """Angle between two vectors in degrees."""
    a, b = unit(one), unit(other)
    return float(np.degrees(2 * np.arctan2(np.linalg.norm(a - b), np.linalg.norm(a + b))))


def turned(direction: npt.ArrayLike, deg: float, random: np.random.Generator) -> Array:
    """A direction at an angle from another, on a random side of it."""
    axis = unit(direction)
    side = unit(np.cross(axis, random_direction(random)))
    return np.cos(np.radians(deg)) * axis + np.sin(np.radians(deg)) * side


def random_direction(random: np.random.Generator) -> Array:
    """A direction, all equally likely."""
    return unit(random.normal(size=3))


def from_elevation(azimuth_deg: float, elevation_deg: float) -> Array:
    """Direction of light that comes from an azimuth (0 from +z, 90 from +x) and an elevation above the floor."""
    a, e = np.radians([azimuth_deg, elevation_deg])
    return -np.array([np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a)])


def text(numbers: Sequence[float] | Array) -> str:
    """Numbers as an XML file has them."""
    return ", ".join(f"{round(float(number), 9):.7g}" for number in np.ravel(numbers))

"""Number of points on an area light: as many as its penumbrae and what is near it need (on the host)."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import numpy as np
import numpy.typing as npt

from ...scene.sensor import Sensor
from .map_aim import Points

#: Fewest and most points that are chosen.
FEWEST, MOST = 8, 32
# Points for each pixel of a penumbra. The edge of each point's shadow is a step; steps closer than pixels are not seen.
_PER_PIXEL = 2.0
# Radius of a light over the distance of what is nearest, from which on it has the most points. The light of what is smaller or
# farther away is as exact with fewer: each part is seen under the same angle.
_NEAR = 0.2
# Receivers and vertices of casters that are looked at; a caster hides a receiver if the light sees both in about one direction.
_RECEIVERS, _BLOCKERS, _TOGETHER = 2048, 512, 0.1
# Triangles whose areas are computed at once.
_PIECE = 1 << 16
# Share of the receivers behind casters whose penumbrae count: the widest ones are those of a few points, far behind.
_COUNTED = 0.95


def area_light_count(light: Points, casters: Sequence[Points], receivers: Points, cameras: Sequence[Sensor]) -> int:
    """Points (a power of two) that an area light needs.

    Args:
        light: vertices (V, 3) of the light's shape.
        casters: vertices (V, 3) of each shape that can cast a shadow.
        receivers: points (R, 3) spread over all other surfaces.
        cameras: all cameras; the one that sees the widest penumbra counts.

    All in world space. A penumbra is as wide as the light's angle, seen from its caster, is on the receiver. Penumbrae that are
    seen from the side, or of a light that is flat and seen from the side, are narrower than assumed.
    """
    centre = 0.5 * (light.min(0) + light.max(0))
    radius = float(np.linalg.norm(light - centre, axis=1).max())
    widths = _widths(_thinned(np.concatenate(casters), _BLOCKERS) - centre, receivers - centre, radius)
    widest = max((_pixels(camera, receivers, widths) for camera in cameras), default=float(MOST))
    nearest = float(np.linalg.norm(receivers - centre, axis=1).min(initial=np.inf)) - radius
    angle = radius / nearest if nearest > 0 else np.inf
    needed = max(_PER_PIXEL * widest, MOST * (angle / _NEAR) ** 2)
    count = FEWEST
    while count < MOST and count < needed:
        count *= 2
    return count


def spread_points(
    positions: npt.NDArray[np.float32], faces: npt.NDArray[np.uint32], count: int = _RECEIVERS
) -> tuple[Points, npt.NDArray[np.int64]]:
    """Points (count, 3) spread over triangles by area, the same in each call, and the triangle of each (count,).

    ``positions``: (V, 3); ``faces``: (F, 3). A scene may have millions of triangles: their corners are looked at in pieces.
    """
    rng = np.random.default_rng(0)
    pieces = (positions[faces[start : start + _PIECE]] for start in range(0, len(faces), _PIECE))
    sums = np.cumsum(np.concatenate([_areas(corners) for corners in pieces]), dtype=np.float64)
    if not sums[-1] > 0:
        return positions[faces[:count, 0]].astype(np.float64), np.arange(min(count, len(faces)))
    face = np.searchsorted(sums / sums[-1], (np.arange(count) + 0.5) / count).clip(0, len(faces) - 1)
    u, v = rng.uniform(size=(2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    a, b, c = positions[faces[face]].astype(np.float64).transpose(1, 0, 2)
    return a + u * (b - a) + v * (c - a), face


def _areas(corners: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Twice the areas of triangles (F, 3, 3)."""
    found: npt.NDArray[np.float32] = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    return found


def _thinned(points: Points, count: int) -> Points:
    return points[:: max(1, len(points) // count)]


def _widths(blockers: Points, receivers: Points, radius: float) -> npt.NDArray[np.float64]:
    """Width of the widest penumbra on each receiver, 0 where nothing hides it. Positions are relative to the light's centre."""
    near, far = np.linalg.norm(blockers, axis=1), np.linalg.norm(receivers, axis=1)
    near, far = np.maximum(near, 1e-12), np.maximum(far, 1e-12)
    together = (receivers / far[:, None]) @ (blockers / near[:, None]).T > np.cos(_TOGETHER)
    behind = far[:, None] - near
    widths = np.where(together & (behind > 0), 2 * radius * behind / near, 0)
    found: npt.NDArray[np.float64] = widths.max(1, initial=0)
    return found


def _pixels(camera: Sensor, points: Points, widths: npt.NDArray[np.float64]) -> float:
    """Width in pixels of the penumbrae that a camera sees, all but the few widest ones."""
    with dr.suspend_grad():
        projection = np.array(dr.detach(camera.view_projection), np.float64).reshape(4, 4)
        across = np.array(dr.detach(camera.to_world.matrix), np.float64).reshape(4, 4)[:3, 0]
    homogeneous = np.insert(points, 3, 1, 1) @ projection.T
    w = homogeneous[:, 3]
    seen = (w > 0) & (np.abs(homogeneous[:, :2]) <= w[:, None]).all(1) & (widths > 0)
    if not seen.any():
        return 0.0
    # How far a step of one unit to the camera's side takes a point on the film. Depth stays the same.
    step = float(np.linalg.norm(projection[:2, :3] @ (across / np.linalg.norm(across)))) * 0.5 * camera.width
    return float(np.quantile(widths[seen] * step / w[seen], _COUNTED))

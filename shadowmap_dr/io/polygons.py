"""Triangles of polygons. A fan covers what lies outside a polygon with a notch; ears do not.

Method: Gary Meisters, "Polygons have ears", 1975.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Faces = npt.NDArray[np.int64]


def triangles(vertices: Array, polygons: Sequence[Sequence[int]]) -> Faces:
    """(F, 3) triangles of polygons: fans, and ears where a corner points inwards. Polygons of two corners have none.

    Args:
        vertices: (V, 3).
        polygons: indices of the corners of each; outside of ``vertices`` they are kept, for the caller to refuse.
    """
    of_length = defaultdict[int, list[int]](list)
    for number, polygon in enumerate(polygons):
        of_length[len(polygon)].append(number)
    found = [np.empty((0, 3), np.int64)]
    for length, numbers in of_length.items():
        if length < 3:
            continue
        corners = np.array([polygons[number] for number in numbers], np.int64)
        notched = np.zeros(len(corners), bool)
        if length > 3 and corners.min() >= 0 and corners.max() < len(vertices):
            notched = concave(vertices[corners])
        fans = corners[~notched]
        found += [fans[:, [0, k, k + 1]] for k in range(1, length - 1)]
        found += [polygon[ears(vertices[polygon])] for polygon in corners[notched]]
    return np.concatenate(found)


def concave(points: Array) -> npt.NDArray[np.bool_]:
    """(P,) truth for polygons (P, N, 3) of which a corner points inwards, by more than rounding."""
    normal = _area(points)
    before, after = points - np.roll(points, 1, 1), np.roll(points, -1, 1) - points
    turns = (np.cross(before, after) * normal[:, None]).sum(-1)
    return np.asarray((turns < -1e-6 * (normal**2).sum(-1, keepdims=True)).any(1))


def ears(points: Array) -> Faces:
    """(N - 2, 3) corners of the triangles of a polygon (N, 3), which need be neither convex nor quite flat.

    Holes may be joined to the outline by a line that is followed twice. Fewer triangles where corners lie on a line.
    """
    flat = _flattened(points)
    left, found = list(range(len(points))), []
    while len(left) > 3:
        at = _ear(flat[left])
        if at is None:  # a polygon that crosses itself
            found += [(left[0], left[k], left[k + 1]) for k in range(1, len(left) - 1)]
            return np.array(found, np.int64)
        if _twice_area(*flat[[left[at - 1], left[at], left[(at + 1) % len(left)]]]) > 0:
            found.append((left[at - 1], left[at], left[(at + 1) % len(left)]))
        del left[at]
    return np.array([*found, left], np.int64)


def _area(points: Array) -> Array:
    """Normals of polygons (..., N, 3), as long as twice their area (Newell)."""
    spokes = points - points[..., :1, :]
    return np.asarray(np.cross(spokes[..., :-1, :], spokes[..., 1:, :]).sum(-2))


def _flattened(points: Array) -> Array:
    """A polygon (N, 3) in its own plane, (N, 2), counter-clockwise."""
    normal = _area(points)
    across = np.cross(np.eye(3)[np.abs(normal).argmin()], normal)
    axes = np.stack([across, np.cross(normal, across)])
    return np.asarray((points - points[0]) @ (axes / np.maximum(np.linalg.norm(axes, axis=1, keepdims=True), 1e-300)).T)


def _twice_area(a: Array, b: Array, c: Array) -> Array:
    """Twice the signed area of triangles in the plane."""
    return np.asarray((b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0]))


def _ear(flat: Array) -> int | None:
    """A corner whose triangle has no other corner within; at first one on a straight line. None if there is none."""
    a, c = np.roll(flat, 1, 0), np.roll(flat, -1, 0)
    areas = _twice_area(a, flat, c)
    extent = float(np.ptp(flat, axis=0).max())
    least = 1e-12 * extent**2
    straight = np.flatnonzero(np.abs(areas) <= least)
    if len(straight):
        return int(straight[0])
    for at in np.flatnonzero(areas > 0):
        corners = (a[at], flat[at], c[at])
        sides = [_twice_area(*edge, flat) for edge in zip(corners, (*corners[1:], corners[0]), strict=True)]
        # Both ends of a line that is followed twice are the same point.
        same = (np.abs(flat[:, None] - np.stack(corners)).max(-1) <= 1e-9 * extent).any(1)
        if not ((np.minimum.reduce(sides) >= -least) & ~same).any():
            return int(at)
    return None

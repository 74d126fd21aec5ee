"""Aim of the shadow maps of an area light. Each map has to see all casters (on the host)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import numpy as np
import numpy.typing as npt

from ...scene.geometry import Geometry, ShapeInfo
from ...shadow.caster_bounds import BORDER, ROUNDING, SUNK, SUNK_UNSEEN, TOUCH

#: Half-angle in degrees that one perspective map may cover: beyond it, a light looks around itself with the faces of a cube.
WIDEST = 75.0
# So many degrees less when a map is first aimed: things move.
_ROOM = 5.0
# Vertices of an emitter that are looked from, beside the corners of its box.
_EYES = 64

Points = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Aim:
    """``target``: middle of the shapes ``casters``; ``surrounded``: from some points of the emitter no map sees them all."""

    target: tuple[float, float, float]
    casters: tuple[int, ...]
    surrounded: bool


def shape_vertices(geometry: Geometry) -> list[Points]:
    """(V, 3) world space, of each shape, read back."""
    positions = dr.detach(geometry.positions).numpy().reshape(-1, 3).astype(np.float64)
    return [positions[i.vertex_start : i.vertex_start + i.vertex_count] for i in geometry.shapes]


def aim(vertices: Sequence[Points], shapes: Sequence[ShapeInfo], own: int, cameras: Points) -> Aim:
    """Aim of maps on the emitter ``own``, at the shapes that can cast shadows.

    ``cameras``: places (C, 4) of all cameras in homogeneous coordinates, world space.
    """
    emitter, others = vertices[own], [k for k in range(len(shapes)) if k != own]
    casters = [k for k in others if _may_cast(shapes, vertices, k, others, emitter.mean(0), cameras)] or others or [own]
    points = np.concatenate([vertices[k] for k in casters])
    centre = 0.5 * (points.min(0) + points.max(0))
    eyes = np.concatenate([_box(emitter), emitter[:: max(1, len(emitter) // _EYES)]])
    x, y, z = centre.tolist()
    return Aim((x, y, z), tuple(casters), _widest(eyes, points, centre) > WIDEST - _ROOM)


def sees_all(emitter: Points, casters: Sequence[Points], target: tuple[float, float, float]) -> bool:
    """True if maps anywhere in the box of an emitter that face a point cover the casters' vertices."""
    eyes, centre = _box(emitter), np.array(target)
    # Boxes are a matter of a few points, and mostly enough.
    boxes = np.concatenate([_box(points) for points in casters])
    return _widest(eyes, boxes, centre) <= WIDEST or _widest(eyes, np.concatenate(casters), centre) <= WIDEST


def _widest(eyes: Points, points: Points, centre: Points) -> float:
    """Largest angle in degrees between what an eye (N, 3) sees of some points (P, 3) and of their centre."""
    widest = 0.0
    for eye in eyes:
        to, axis = points - eye, centre - eye
        length = np.linalg.norm(to, axis=1) * np.linalg.norm(axis)
        cosine = (to @ axis) / np.maximum(length, 1e-12)
        widest = max(widest, float(np.degrees(np.arccos(np.clip(cosine.min(), -1, 1)))))
    return widest


def _may_cast(
    shapes: Sequence[ShapeInfo], parts: Sequence[Points], k: int, others: Sequence[int], light: Points, cameras: Points
) -> bool:
    """True if something lies behind a shape, as seen from the light. Nothing lies behind walls and floors."""
    if not shapes[k].planar:
        return True
    own = parts[k]
    middle = own.mean(0)
    _, _, axes = np.linalg.svd(own - middle, full_matrices=False)
    side = np.sign((light - middle) @ axes[-1])
    floor = (own - middle) @ axes.T
    eyes = np.concatenate([(cameras[:, :3] - cameras[:, 3:] * middle) @ axes.T, cameras[:, 3:]], 1)
    for other in (parts[o] for o in others if o != k):
        placed = (other - middle) @ axes.T
        border = BORDER * np.ptp(floor, axis=0)
        stands = ((placed.min(0) >= floor.min(0) + border) & (placed.max(0) <= floor.max(0) - border))[:2].all()
        behind = -side * placed[:, 2]
        touch = TOUCH * min(np.ptp(own, axis=0).max(), np.ptp(other, axis=0).max()) + ROUNDING * np.abs(other).max()
        share = 0.0
        if stands:
            hidden = not shapes[k].see_through and len(eyes) and all(_hides(floor, border, placed, side, eye) for eye in eyes)
            share = SUNK_UNSEEN if hidden else SUNK
        if behind.max() - share * np.ptp(behind) > touch:
            return True
    return False


def _hides(floor: Points, border: Points, points: Points, side: float, eye: Points) -> bool:
    """True if a floor hides all points behind it from a camera. All in the floor's frame; ``side``: sign of z in front of it."""
    height, depth = side * eye[2], -side * points[:, 2]
    behind, depth = points[depth > 0], depth[depth > 0, None]
    if height <= 0:
        return False
    through = (behind * height + eye[:3] * depth) / (height + eye[3] * depth)
    return bool(((through >= floor.min(0) + border) & (through <= floor.max(0) - border))[:, :2].all())


def _box(points: Points) -> Points:
    low, high = points.min(0), points.max(0)
    return np.stack([np.where([i & 1, i & 2, i & 4], high, low) for i in range(8)])

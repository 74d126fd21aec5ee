"""Difficult scenes for pre-filtered shadow maps: a receiver seen from above under a directional light."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ..common.objects import occluder

Mesh = tuple[npt.NDArray[np.float32], npt.NDArray[np.uint32]]

#: Half-size of the square that the camera sees, world units.
HALF = 2.0


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Mesh:
    """An axis-parallel box, faces outwards."""
    corners = np.array([[(high if k & bit else low)[c] for c, bit in enumerate((1, 2, 4))] for k in range(8)], np.float32)
    quads = [(0, 4, 6, 2), (1, 3, 7, 5), (0, 1, 5, 4), (2, 6, 7, 3), (0, 2, 3, 1), (4, 5, 7, 6)]
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return corners, np.array(faces, np.uint32)


def merged(meshes: list[Mesh]) -> Mesh:
    """Several meshes as one."""
    starts = np.cumsum([0, *(len(points) for points, _ in meshes)])
    faces = [faces + np.uint32(start) for (_, faces), start in zip(meshes, starts, strict=False)]
    return np.concatenate([points for points, _ in meshes]), np.concatenate(faces)


def _overlap(offset: float) -> dict[str, Mesh]:
    """Occluders at heights 4 and 1 with partly overlapping shadows: high variance of depth within the shadow."""
    high = box((-1.2 + offset - 1.0, 4.0, -0.9), (0.3 + offset - 1.0, 4.1, 0.6))
    low = box((-0.6, 1.0, -0.3), (0.9, 1.1, 1.2))
    return {"high": high, "low": low}


def _tiers(offset: float) -> dict[str, Mesh]:
    """Likewise, but the occluders are visible beside their shadows."""
    return {"high": box((-1.9 + offset, 2.4, -0.9), (-0.4 + offset, 2.5, 0.6)), "low": box((-0.9, 0.8, -0.3), (0.3, 0.9, 1.2))}


def _fence(offset: float) -> dict[str, Mesh]:
    """Thin pickets and two rails."""
    pickets = [box((x + offset, 0.0, -0.03), (x + offset + 0.06, 1.2, 0.03)) for x in np.arange(-1.8, 1.8, 0.24)]
    rails = [box((-1.9 + offset, y, 0.03), (1.9 + offset, y + 0.08, 0.07)) for y in (0.3, 0.9)]
    return {"fence": merged(pickets + rails)}


def _sheet(offset: float) -> dict[str, Mesh]:
    """A crumpled sheet with ridges in random directions, which shadows itself."""
    n = 241
    rng = np.random.default_rng(5)
    line = np.linspace(-1.7, 1.7, n)
    x, z = np.meshgrid(line, line, indexing="ij")
    height = np.full_like(x, 0.6)
    for _ in range(7):
        angle, phase = rng.uniform(0, 2 * np.pi, 2)
        frequency = rng.uniform(1.0, 3.5)
        wave = np.sin(frequency * (np.cos(angle) * x + np.sin(angle) * z) + phase)
        height += 0.6 / frequency * np.hypot(wave, 0.2)
    points = np.stack([x + offset, height, z], -1).reshape(-1, 3).astype(np.float32)
    a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([a, a + 1, a + n], 1), np.stack([a + 1, a + n + 1, a + n], 1)])
    return {"sheet": (points, faces.astype(np.uint32))}


def _deep(offset: float) -> dict[str, Mesh]:
    """Occluders at heights 1 and 1000: everything near the floor shares a thousandth of the depth range."""
    far = 1000.0
    return {
        "near": merged([box((-1.0 + offset, 0.3, -0.8), (-0.6 + offset, 1.0, -0.4)), box((0.2, 0.3, -0.2), (1.2, 0.4, 0.6))]),
        "far": box((-0.9 - far * _SLANT[0], far, 0.7 - far * _SLANT[2]), (0.4 - far * _SLANT[0], far + 1, 1.3 - far * _SLANT[2])),
    }


# Travel directions of light, scaled to one unit downwards.
_SLANT = (0.25, -1.0, 0.15)
_LOW_SLANT = (0.35, -1.0, -0.55)

#: Name -> (function that makes the meshes for an offset of the casters along x, travel direction of the light).
SCENES: Mapping[str, tuple[Callable[[float], dict[str, Mesh]], tuple[float, float, float]]] = {
    "overlap": (_overlap, _SLANT),
    "tiers": (_tiers, (0.6, -1.0, 0.1)),
    "fence": (_fence, _LOW_SLANT),
    "sheet": (_sheet, (0.9, -1.0, 0.3)),
    "deep": (_deep, _SLANT),
}


def build(name: str, resolution: int, offset: float = 0.0) -> mi.Scene:
    """Make a scene: diffuse floor (y = 0) and occluders, a directional light, an orthographic camera that looks down.

    The camera is above the sheet, the fence and the tiers, and below the other occluders, which are not visible.
    """
    meshes, direction = SCENES[name]
    height = {"overlap": 0.25, "deep": 0.25, "tiers": 4.0}.get(name, 3.0)
    t = mi.ScalarTransform4f
    scene: dict[str, Any] = {
        "type": "scene",
        "camera": {
            "type": "orthographic",
            "near_clip": 0.01,
            "far_clip": 10.0,
            "to_world": t().look_at([0, height, 0], [0, 0, 0], [0, 0, 1]) @ t().scale([HALF, HALF, 1]),
            "film": {"type": "hdrfilm", "width": resolution, "height": resolution, "rfilter": {"type": "box"}},
        },
        "sun": {"type": "directional", "direction": list(direction), "irradiance": {"type": "rgb", "value": float(np.pi)}},
        "floor": {
            "type": "rectangle",
            "to_world": t().rotate([1, 0, 0], -90) @ t().scale(4 * HALF),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}},
        },
    }
    for key, (points, faces) in meshes(offset).items():
        scene[key] = occluder(key, points, faces)
    return mi.load_dict(scene, optimize=False)  # otherwise Mitsuba would merge the meshes, and their names were lost

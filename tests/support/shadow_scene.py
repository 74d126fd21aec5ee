"""Helpers for the tests of shadow maps: casters as plain arrays, and a brute-force shadow ray in NumPy."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from shadowmap_dr.raster import build_topology
from shadowmap_dr.shadow import (
    Frusta,
    LightView,
    ShadowMaps,
    ShadowSettings,
    filter_maps,
    fit_frusta,
    render_maps,
    shape_bounds,
    stack_views,
    to_light_space,
)
from shadowmap_dr.shadow.light_camera import of_map


def make_maps(
    views: list[LightView],
    vertices,  # noqa: ANN001  Point3f
    world: np.ndarray,
    faces: np.ndarray,
    settings: ShadowSettings,
    previous: Frusta | None = None,
    frusta: Frusta | None = None,
    seen=None,  # noqa: ANN001  Point3f
) -> ShadowMaps:
    """Shadow maps of one non-planar shape."""
    stacked = stack_views(views)
    count, n = len(views), len(world)
    lane = dr.arange(mi.UInt32, count * n)
    map_index = lane // n
    p_world = dr.gather(mi.Point3f, dr.ravel(vertices), lane - map_index * n)
    p_light = to_light_space(of_map(stacked, map_index, count), p_world)
    if frusta is None:
        bounds = shape_bounds(stacked, p_light, map_index, mi.UInt32(0), 1)
        size, kernel, nearer = settings.resolution, settings.filter_size, settings.receiver_range
        frusta = fit_frusta(stacked, bounds, mi.Bool(True), 1, size, kernel, previous, seen, nearer)
    topology = build_topology(faces, world, mi.UInt32)
    flat_faces = mi.UInt32(faces.ravel().astype(np.uint32))
    return filter_maps(render_maps(p_light, map_index, flat_faces, topology, stacked, frusta, settings))


def occluded(origins: np.ndarray, targets: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Does any triangle cut the segment? And the distance of the segment's crossing from the nearest triangle edge."""
    hit = np.zeros(len(origins), bool)
    margin = np.full(len(origins), np.inf)
    for a, b, c in triangles:
        normal = np.cross(b - a, c - a)
        d = targets - origins
        t = ((a - origins) @ normal) / (d @ normal)
        p = origins + t[:, None] * d
        edge = [
            np.cross(v - u, p - u) @ normal / np.linalg.norm(normal) / np.linalg.norm(v - u) for u, v in ((a, b), (b, c), (c, a))
        ]
        inside = np.min(edge, 0)
        between = (t > 1e-6) & (t < 1 - 1e-6)
        hit |= between & (inside > 0)
        margin = np.where(between & (inside > -0.3), np.minimum(margin, np.abs(edge).min(0)), margin)
    return hit, margin

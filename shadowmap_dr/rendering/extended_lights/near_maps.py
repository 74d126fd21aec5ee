"""Second maps of directions of a sky, for what lies near the cameras.

Under a sky, terrain casts shadows from all sides: one map of a direction has to show all of it. But most pixels look at the part
in front of the camera. There, a second map has smaller texels and a shorter range of depths.

Source: Engel, "Cascaded Shadow Maps", ShaderX5, 2006; here the parts are bounded by what is seen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from ...jit.types import Bool, Point3f, UInt32, Vector4f
from ...scene.geometry import Geometry
from ...scene.sensor import Sensor
from ...shadow import ShadowMaps, project
from ...shadow.light_camera import of_map
from ...shadow.lookup import has_neighbours
from ...shadow.tile_fit import BINS, even_bins
from .map_aim import Points, shape_vertices

# Share of what a camera sees that counts as near.
_NEAR = 0.75
# Extent of the casters, in widths of what a camera sees there, from which on second maps are worth their time.
_WIDE = 3


def want_near_maps(geometry: Geometry, receivers: Points, cameras: Sequence[Sensor]) -> bool:
    """True if casters that are not planar reach much farther than most of what a camera sees. Reads back.

    Args:
        geometry: of the scene. Planes hardly ever widen maps (:func:`shadowmap_dr.shadow.casting_shapes`).
        receivers: (R, 3) points spread over all surfaces.
        cameras: cameras of the scene. Orthographic ones see everything from afar.
    """
    vertices = shape_vertices(geometry)
    solid = [vertices[k] for k, info in enumerate(geometry.shapes) if not info.planar and len(vertices[k])]
    if not solid or any(camera.kind != "perspective" for camera in cameras):
        return False
    low, high = np.min([v.min(0) for v in solid], 0), np.max([v.max(0) for v in solid], 0)
    extent = float((high - low).max())
    return any(extent > _WIDE * width for width in (_width(camera, receivers) for camera in cameras))


def _width(camera: Sensor, receivers: Points) -> float:
    """Width of what a camera sees at the distance of the farthest of the near points; infinite if it sees none."""
    with dr.suspend_grad():
        eye, forward = (np.array(v, np.float64).reshape(3) for v in (camera.origin, camera.direction))
        slope = math.tan(math.radians(0.5 * float(camera.x_fov[0])))
    offset = receivers - eye
    depth = offset @ forward
    distance = np.linalg.norm(offset, axis=1)
    # Within a cone around the picture. Points stand for equal areas, which look the smaller the farther they are.
    seen = (depth > 0) & (distance <= depth * math.hypot(1, math.sqrt(2) * slope))
    if not seen.any():
        return math.inf
    order = np.argsort(distance[seen])
    near = distance[seen][order]
    share = np.cumsum(1 / np.maximum(near, 1e-6) ** 2)
    return 2 * slope * float(near[np.searchsorted(share, _NEAR * share[-1])])


def near_points(points: tuple[Point3f, Bool], eyes: Vector4f) -> Bool:
    """Mask of the visible points near the cameras. Detached.

    ``points``: (points in world space, mask of valid ones). ``eyes``: places of all cameras, in homogeneous coordinates.
    """
    place, active = points
    with dr.suspend_grad():
        distance = dr.full(mi.Float, dr.inf, dr.width(place))
        for k in range(dr.width(eyes)):
            eye = [dr.gather(mi.Float, eyes[c], mi.UInt32(k)) for c in range(4)]
            distance = dr.minimum(distance, dr.norm(mi.Vector3f(place) * eye[3] - mi.Vector3f(*eye[:3])))
        bins, _ = even_bins(distance, dr.zeros(mi.UInt32, dr.width(distance)), 1, active)
        return mi.Bool(active) & (bins < int(_NEAR * BINS))


def lies_within(maps: ShadowMaps, index: UInt32, p_world: Point3f) -> Bool:
    """Mask of points that maps with an index show, within their range of depths. Detached."""
    with dr.suspend_grad():
        view, frustum = of_map(dr.detach(maps.views), index, maps.views.count), of_map(maps.frusta, index, maps.count)
        u, v, depth, inside = project(view, frustum, dr.detach(mi.Point3f(p_world)))
        return inside & has_neighbours(maps.settings, view, frustum, u, v) & (dr.abs(depth) <= 0.5)

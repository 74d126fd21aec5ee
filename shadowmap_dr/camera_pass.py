"""What the camera sees: clip-space vertices, the G-buffer, and the spots on the surface that a pixel looks at."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .geometry import Geometry
from .sensors import Sensor
from .spread import spread


def camera_clip(sensor: Sensor, geometry: Geometry, center: tuple[float, float, float], radius: float) -> Any:
    """Clip-space vertices (Float, 4 V) for the rasterizer. Attached to vertices and camera.

    Depths differ from ``Sensor.view_projection``, whose near and far planes (0.01 and 10,000 by default) leave little of
    single precision: a perspective camera stores -near / distance, which keeps full relative precision at any distance, and an
    orthographic one spreads its range over the scene (a sphere, with room around it) instead of up to the far plane.
    """
    projection, view = sensor.projection, sensor.view
    near, far = dr.detach(sensor.near), dr.detach(sensor.far)
    if sensor.kind == "perspective":
        depth = [0.0, 0.0, 0.0, -near]
    else:
        reach = dr.norm(dr.detach(sensor.origin) - mi.Point3f(*center)) + radius
        reach = dr.minimum(far - near, 4 * reach)
        depth = [0.0, 0.0, 2 / reach, -1 - 2 * near / reach]
    rows = [[projection[r, c] for c in range(4)] for r in (0, 1, 3)]
    to_clip = mi.Matrix4f(rows[0], rows[1], depth, rows[2]) @ view
    lanes = geometry.vertex_count
    m = spread(to_clip, lanes)
    p = dr.gather(mi.Point3f, geometry.positions, dr.arange(mi.UInt32, lanes))
    row = [dr.fma(m[r, 0], p.x, dr.fma(m[r, 1], p.y, dr.fma(m[r, 2], p.z, m[r, 3]))) for r in range(4)]
    # Identities written out: a row of zeros would still be multiplied with every vertex.
    return dr.ravel(mi.Point4f(*row))


def view_frustum(sensor: Sensor, center: tuple[float, float, float], radius: float) -> Any:
    """The 8 corners (Point3f, world space, detached) of what a camera can see of a scene around ``center``.

    The far side lies behind the scene, with room for three radii of movement, or at the far plane.
    """
    with dr.suspend_grad():
        matrix = dr.detach(sensor.to_world.matrix)
        projection = dr.detach(sensor.projection)
        axis = dr.normalize(mi.Vector3f(matrix[0, 2], matrix[1, 2], matrix[2, 2]))
        reach = dr.dot(axis, mi.Point3f(*center) - dr.detach(sensor.origin)) + 4 * radius
        near = dr.detach(sensor.near)
        far = dr.maximum(dr.minimum(dr.detach(sensor.far), reach), near)
        corner = dr.arange(mi.UInt32, 8)
        x, y = (dr.select(corner & bit != 0, mi.Float(1), -1) for bit in (1, 2))
        z = dr.select(corner & 4 != 0, far, near)
        scale = z if sensor.kind == "perspective" else mi.Float(1)
        shift = (2, 2) if sensor.kind == "perspective" else (3, 3)
        local = mi.Point3f(
            (x - projection[0, shift[0]]) / projection[0, 0] * scale,
            (y - projection[1, shift[1]]) / projection[1, 1] * scale,
            z,
        )
        return mi.Transform4f(matrix) @ local


def within_far_plane(sensor: Sensor, w_clip: Any) -> Any:
    """Mask of the pixels whose surface lies before a perspective camera's far plane."""
    return w_clip <= dr.detach(sensor.far) if sensor.kind == "perspective" else mi.Bool(True)


def footprint_points(sensor: Sensor, size: tuple[int, int], w_clip: Any, p_world: Any, n_world: Any, count: int) -> list[Any]:
    """``count`` x ``count`` points spread over a pixel's footprint on the tangent plane of what it sees (Point3f each).

    Attached to ``p_world`` only: the spread itself is detached.
    """
    if count == 1:
        return [p_world]
    with dr.suspend_grad():
        width, height = size
        matrix = dr.detach(sensor.to_world.matrix)
        right, up, forward = (dr.normalize(mi.Vector3f(matrix[0, k], matrix[1, k], matrix[2, k])) for k in range(3))
        projection = dr.detach(sensor.projection)
        if sensor.kind == "perspective":
            scale = dr.detach(w_clip)
            view = dr.normalize(dr.detach(p_world) - dr.detach(sensor.origin))
        else:
            # An orthographic camera's scale lies in its transformation, whose columns were normalised above.
            scale = mi.Float(1)
            right *= dr.norm(mi.Vector3f(matrix[0, 0], matrix[1, 0], matrix[2, 0]))
            up *= dr.norm(mi.Vector3f(matrix[0, 1], matrix[1, 1], matrix[2, 1]))
            view = forward
        right *= 2 / (width * dr.abs(projection[0, 0])) * scale
        up *= 2 / (height * dr.abs(projection[1, 1])) * scale
        n = dr.detach(n_world)
        slope = dr.dot(n, view)
        # Seen at a grazing angle the footprint grows without bound; four pixels long is as much as makes sense.
        slope = dr.select(slope < 0, dr.minimum(slope, -0.25), dr.maximum(slope, 0.25))
        offsets = []
        for j in range(count):
            for i in range(count):
                lateral = right * ((i + 0.5) / count - 0.5) + up * ((j + 0.5) / count - 0.5)
                offsets.append(lateral - view * (dr.dot(n, lateral) / slope))
    return [p_world + offset for offset in offsets]

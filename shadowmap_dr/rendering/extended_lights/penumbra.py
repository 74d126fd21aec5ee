"""Penumbrae from a single shadow map: their width follows from the distance of occluders to the receiver.

Percentage-closer soft shadows on a pyramid of filtered moments. Sources: Fernando, "Percentage-Closer Soft Shadows", 2005; Yang
et al., "Variance Soft Shadow Mapping", 2010 (mean depth of occluders from moments, section 3.1).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ...jit.arrays import backend
from ...jit.kernel_inputs import float_input, uint_input
from ...jit.types import Bool, Float, Point3f, PyTree, UInt32, Vector2f, Vector3f
from ...scene.sums import sum_over
from ...shadow import Frusta, ShadowMaps, Views, chebyshev_visibility
from ...shadow.light_camera import of_map, to_light_space
from ...shadow.shadow_map import block_means
from ...shadow.texel_depths import FAR

# Places that are looked at for occluders, and again for visibility.
_TAPS = 16
# Largest filter, as a fraction of the map.
_WIDEST = 0.25


@dataclass(frozen=True)
class Pyramid:
    """Moments of M maps, each level with half as many texels along a side as the one before.

    ``values``: flat ``Float``, levels one after the other, two numbers a texel, attached. ``maps``: the finest level.
    """

    values: Float
    maps: ShadowMaps
    levels: int

    @classmethod
    def of(cls, maps: ShadowMaps) -> Pyramid:
        """From unfiltered variance shadow maps whose resolution is a power of two."""
        size, level = maps.settings.resolution, maps.values
        levels = [level]
        while size > 4:
            level = block_means(level, size, maps.channels, 2)
            levels.append(level)
            size //= 2
        values = dr.concat(levels)
        dr.eval(values)
        return cls(values, maps, len(levels))

    def look_up(self, which: UInt32, x: Float, y: Float, level: UInt32) -> Vector2f:
        """Moments (``Array2f``) at places in 0..1 of map ``which`` on a level (``UInt32``), bilinear; far away outside.

        Attached to all but the level.
        """
        full, count = self.maps.settings.resolution, self.maps.views.count
        texels = uint_input(backend(level), "texels", full)
        size = mi.UInt32(texels) >> level
        # 1 + 1/4 + 1/16 + ... of the texels of the finest level come first; exact, since sizes are powers of two.
        before = (mi.UInt32(texels * texels) - size * size) // 3 * 4 * count + which * size * size
        fx, fy = (dr.fma(v, mi.Float(size), -0.5) for v in (x, y))
        x0, y0 = dr.floor(dr.detach(fx)), dr.floor(dr.detach(fy))
        fx, fy = fx - x0, fy - y0
        last = mi.Int32(size) - 1
        column = [mi.UInt32(dr.clip(mi.Int32(x0) + i, 0, last)) for i in range(2)]
        row = [mi.UInt32(dr.clip(mi.Int32(y0) + j, 0, last)) for j in range(2)]
        rows = []
        for j in range(2):
            left, right = (dr.gather(mi.Vector2f, self.values, before + row[j] * size + column[i]) for i in range(2))
            rows.append(dr.fma(right - left, fx, left))
        inside = (x > 0) & (x < 1) & (y > 0) & (y < 1)
        return dr.select(inside, dr.fma(rows[1] - rows[0], fy, rows[0]), mi.Vector2f(FAR, FAR * FAR))


def penumbra_visibility(
    pyramid: Pyramid, which: UInt32, radius: Float, p_world: Point3f, n_world: Vector3f, active: Bool | bool = True
) -> Float:
    """Fraction of a light of this ``radius`` (``Float``, world units, as a disk) that world-space points see (``Float``).

    ``which``: map (``UInt32``), drawn from the light's centre. ``n_world``: geometric normals: what lies on the tangent plane of
    a point does not hide it. In 0..1; 1 for points that are not ``active``. Attached to points, casters, light and radius, but
    not to the tangent plane, nor through the level of the pyramid.
    """
    lanes = (radius, mi.Point3f(p_world), which, dr.detach(n_world), mi.Bool(active))
    start = dr.zeros(mi.Vector2f, dr.width(p_world))

    def occluders(index: UInt32, lanes: PyTree, pyramid: Pyramid) -> Vector2f:
        radius, p_world, which, n_world, active = lanes
        at = _Place.of(pyramid, which, p_world, n_world, active)
        moments, depth = at.look_up(pyramid, which, index, at.footprint(radius, at.nearest), attached=False)
        lit = chebyshev_visibility(moments, depth)
        return dr.select(moments.x < depth, mi.Vector2f(1 - lit, moments.x - lit * depth), 0)

    blocked, depths = sum_over(occluders, _TAPS, start, lanes, pyramid, active=active)
    some = blocked > 1e-4
    mean = dr.select(some, depths / dr.select(some, blocked, 1), -0.5)
    dr.eval(mean, some)

    def passing(index: UInt32, lanes: PyTree, pyramid: Pyramid) -> Vector2f:
        (radius, p_world, which, n_world, active), mean = lanes
        at = _Place.of(pyramid, which, p_world, n_world, active)
        nearer = at.frustum.first + (mean + 0.5) * (at.frustum.far - at.frustum.first)
        moments, depth = at.look_up(pyramid, which, index, at.footprint(radius, dr.maximum(nearer, at.nearest)))
        return mi.Vector2f(chebyshev_visibility(moments, depth), 0)

    total, _ = sum_over(passing, _TAPS, start, (lanes, mean), pyramid, active=active)
    return dr.select(mi.Bool(active) & some, total * (1 / _TAPS), 1)


@dataclass(frozen=True)
class _Place:
    """Places of points in their maps: (x, y) in 0..1, distance z along the light's axis, and the tilt of their tangent planes."""

    view: Views
    frustum: Frusta
    x: Float
    y: Float
    z: Float
    plane: tuple[Float, Float]

    @classmethod
    def of(cls, pyramid: Pyramid, which: UInt32, p_world: Point3f, n_world: Vector3f, active: Bool) -> _Place:
        maps = pyramid.maps
        count = maps.views.count
        view, frustum = of_map(maps.views, which, count), of_map(maps.frusta, which, count)
        p = to_light_space(view, p_world)
        z = dr.select(mi.Bool(active) & (p.z > 1e-6 * frustum.far), p.z, 1)
        sx, sy = p.x / z, p.y / z
        with dr.suspend_grad():
            n = [dr.dot(mi.Vector3f(dr.detach(n_world)), dr.detach(axis)) for axis in (view.right, view.up, view.forward)]
            facing = dr.detach(sx) * n[0] + dr.detach(sy) * n[1] + n[2]
            facing = dr.select(facing == 0, 1, facing)
            plane = (2 * frustum.half_x * n[0] / facing, 2 * frustum.half_y * n[1] / facing)
        x = 0.5 + 0.5 * (sx - frustum.center_x) / frustum.half_x
        y = 0.5 + 0.5 * (sy - frustum.center_y) / frustum.half_y
        return cls(view, frustum, x, y, z, plane)

    @property
    def nearest(self) -> Float:
        """Distance at which the search for occluders begins."""
        return dr.maximum(self.frustum.first, self.frustum.near)

    def footprint(self, radius: Float, z_occluder: Float) -> tuple[Float, Float]:
        """Extent of the rays from the point to the rim of the light at a distance: half-axes in units of the map."""
        slope = radius * dr.maximum(self.z - z_occluder, 0) / (self.z * z_occluder)
        x, y = (dr.minimum(0.5 * slope / half, _WIDEST) for half in (self.frustum.half_x, self.frustum.half_y))
        return x, y

    def look_up(
        self, pyramid: Pyramid, which: UInt32, tap: UInt32, radii: tuple[Float, Float], attached: bool = True
    ) -> tuple[Vector2f, Float]:
        """(moments at a sample place of an ellipse around the point, depth of the point's tangent plane at that place)."""
        rx, ry = radii if attached else (dr.detach(r) for r in radii)
        # Each place stands for its share of the ellipse.
        texels = dr.detach(dr.maximum(rx, ry)) * float_input(
            backend(rx), "texels", pyramid.maps.settings.resolution * math.sqrt(math.pi / _TAPS)
        )
        level = mi.UInt32(dr.clip(dr.log2(dr.maximum(texels, 1)) + 0.5, 0, pyramid.levels - 1))
        number = mi.Float(tap)
        sine, cosine = dr.sincos(number * (math.pi * (3 - math.sqrt(5))))
        r = dr.sqrt((number + 0.5) * (1 / _TAPS))
        dx, dy = rx * (r * cosine), ry * (r * sine)
        # Planes seen edge-on run away to infinity: as far as half the distance is far enough.
        ratio = dr.clip(dr.detach(dx) * self.plane[0] + dr.detach(dy) * self.plane[1], -0.5, 0.5)
        f = self.frustum
        depth = (self.z / (1 + ratio) - f.first) / (f.far - f.first) - 0.5
        return pyramid.look_up(which, self.x + dx, self.y + dy, level), dr.select(depth > FAR, FAR, depth)

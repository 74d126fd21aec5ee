"""Penumbrae from a single shadow map: how far occluders lie before the receiver tells how wide the shadow's edge is.

Percentage-closer soft shadows on a pyramid of filtered moments. Sources: Fernando, "Percentage-Closer Soft Shadows", 2005; Yang
et al., "Variance Soft Shadow Mapping", 2010 (mean depth of occluders from moments, section 3.1).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ..shadow import ShadowMaps, chebyshev_visibility
from ..shadow.camera import of_map, to_light_space
from ..shadow.shadow_map import FAR, block_means

# Places that are looked at for occluders, and again for visibility.
_TAPS = 16
# Largest filter, as a fraction of the map.
_WIDEST = 0.25


@dataclass(frozen=True)
class Pyramid:
    """Moments of M maps, each level with half as many texels along a side as the one before.

    ``values``: flat ``Float``, levels one after the other, two numbers a texel, attached. ``maps``: the finest level.
    """

    values: Any
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

    def look_up(self, which: Any, x: Any, y: Any, level: Any) -> Any:
        """Moments (``Array2f``) at places in 0..1 of map ``which`` on a level (``UInt32``), bilinear; far away outside.

        Attached to all but the level.
        """
        full, count = self.maps.settings.resolution, self.maps.views.count
        size = mi.UInt32(full) >> level
        # 1 + 1/4 + 1/16 + ... of the texels of the finest level come first; exact, since sizes are powers of two.
        before = (mi.UInt32(full * full) - size * size) // 3 * 4 * count + which * size * size
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


def penumbra_visibility(pyramid: Pyramid, which: Any, radius: Any, p_world: Any, n_world: Any, active: Any = True) -> Any:
    """Fraction of a light of this ``radius`` (``Float``, world units, as a disk) that world-space points see (``Float``).

    ``which``: map (``UInt32``), drawn from the light's centre. ``n_world``: geometric normals: what lies on the tangent plane of
    a point does not hide it. In 0..1; 1 for points that are not ``active``. Attached to points, casters, light and radius, but
    not to the tangent plane, nor through the level of the pyramid.
    """
    maps = pyramid.maps
    count = maps.views.count
    view, frustum = of_map(maps.views, which, count), of_map(maps.frusta, which, count)
    p = to_light_space(view, p_world)
    active = mi.Bool(active) & (p.z > 1e-6 * frustum.far)
    z = dr.select(active, p.z, 1)
    x = 0.5 + 0.5 * (p.x / z - frustum.center_x) / frustum.half_x
    y = 0.5 + 0.5 * (p.y / z - frustum.center_y) / frustum.half_y
    depth_range = frustum.far - frustum.first
    plane = [dr.detach(dr.dot(mi.Vector3f(n_world), axis)) for axis in (view.right, view.up, view.forward)]
    facing = dr.detach(p.x / z * plane[0] + p.y / z * plane[1] + plane[2])

    def depth_at(dx: Any, dy: Any) -> Any:
        """Linear depth of the point's tangent plane at a place (dx, dy) away from it in the map."""
        tilt = (dx * frustum.half_x * plane[0] + dy * frustum.half_y * plane[1]) * 2
        # Planes seen edge-on run away to infinity: as far as half the distance is far enough.
        ratio = dr.clip(dr.detach(tilt) / dr.select(facing == 0, 1, facing), -0.5, 0.5)
        linear = (z / (1 + ratio) - frustum.first) / depth_range - 0.5
        return dr.select(linear > FAR, FAR, linear)

    def footprint(z_occluder: Any) -> tuple[Any, Any]:
        """Where rays from the point to the rim of the light pass a depth: half-axes in units of the map."""
        slope = radius * dr.maximum(z - z_occluder, 0) / (z * z_occluder)
        return tuple(dr.minimum(0.5 * slope / half, _WIDEST) for half in (frustum.half_x, frustum.half_y))

    nearest = dr.maximum(frustum.first, frustum.near)
    search = [dr.detach(r) for r in footprint(nearest)]
    blocked, blocker = mi.Float(0), mi.Float(0)
    for dx, dy, moments in _taps(pyramid, which, x, y, *search):
        depth = depth_at(dx, dy)
        lit = chebyshev_visibility(moments, depth)
        dark = moments.x < depth
        blocked += dr.select(dark, 1 - lit, 0)
        blocker += dr.select(dark, moments.x - lit * depth, 0)
    some = blocked > 1e-4
    mean = dr.select(some, blocker / dr.select(some, blocked, 1), -0.5)
    z_blocker = dr.maximum((mean + 0.5) * depth_range + frustum.first, nearest)
    total = mi.Float(0)
    for dx, dy, moments in _taps(pyramid, which, x, y, *footprint(z_blocker)):
        total += chebyshev_visibility(moments, depth_at(dx, dy))
    return dr.select(active & some, total * (1 / _TAPS), 1)


def _taps(pyramid: Pyramid, which: Any, x: Any, y: Any, rx: Any, ry: Any) -> Any:
    """(offset, offset, moments) at places all over an ellipse around (x, y)."""
    size = pyramid.maps.settings.resolution
    # Each place stands for its share of the ellipse.
    texels = dr.detach(dr.maximum(rx, ry)) * size * math.sqrt(math.pi / _TAPS)
    level = mi.UInt32(dr.clip(dr.log2(dr.maximum(texels, 1)) + 0.5, 0, pyramid.levels - 1))
    for k in range(_TAPS):
        r, angle = math.sqrt((k + 0.5) / _TAPS), k * math.pi * (3 - math.sqrt(5))
        dx, dy = rx * (r * math.cos(angle)), ry * (r * math.sin(angle))
        yield dx, dy, pyramid.look_up(which, x + dx, y + dy, level)

"""Maps of directional lights together with their derivatives by the lights' directions, in forward mode.

A light's direction has two degrees of freedom, and a map depends only on its own light. So two tangents for each map and each
looked-up point are all derivatives by the lights' directions. They need no atomic operations, no second pass over the points, and
no derivatives of vertices: when a light turns, points with light-space coordinates (x, y, z) move by linear functions of these
coordinates, and so do all points on triangles and edges.

Turning by (a, b) means: the light's ``forward`` axis moves by ``a right + b up``. The other axes follow as
:func:`shadowmap_dr.shadow.directional_view` makes them, which includes a twist about ``forward`` of ``a * twist``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from ..jit.arrays import backend, ravel
from ..jit.kernel_inputs import float_input, split
from ..jit.types import Bool, Float, Point3f, UInt32
from ..raster import Topology, find_crossings, visible_triangles
from .filters import filter_kernel, filter_map, separable_terms
from .light_camera import Frusta, Views, of_map, project, to_clip, to_light_space
from .light_tangent_texels import TangentTexels, turned, twist_of, weight_rates
from .lookup import Texels, entries, has_neighbours, moved_weights, stored_texel
from .methods.depth_scale import DepthScale
from .methods.registry import PREFILTERED
from .methods.variance import reduced_bleeding
from .settings import ShadowSettings
from .shadow_map import ShadowMaps, block_means
from .texel_depths import FAR, depth_scale


@dataclass(frozen=True)
class TangentMaps:
    """A batch of M maps of directional lights and how they change when the lights turn. Detached.

    Attributes:
        maps: maps as :func:`shadowmap_dr.shadow.filter_maps` returns them, or unfiltered if look-ups apply the filter.
        tangents: (M * N * N * 2 C,), flat: change of a texel's C numbers with a, then with b.
        twist: (M,) see the head of this module.
        taps: (weights along columns, along rows) of the filter that look-ups apply, ([1], [1]) if the maps are filtered.
    """

    maps: ShadowMaps
    tangents: Float
    twist: Float
    taps: tuple[list[float], list[float]]


# A filter of size k reads (k + 1)^2 texels in each look-up; applied beforehand, it reads 2 k texels for each texel of the map.
_WIDEST_TAPS = 3


def tangent_maps(
    p_world: Point3f,
    faces: UInt32,
    topology: Topology,
    views: Views,
    frusta: Frusta,
    settings: ShadowSettings,
    outward: Bool | None = None,
) -> TangentMaps:
    """Render and filter maps of directional lights, with tangents.

    Args:
        p_world: (V,) vertices.
        faces: (3 F,), flat, valid indices.
        topology: topology of the mesh.
        views, frusta: cameras of the M maps, all orthographic, with axes as :func:`directional_view` makes them.
        settings: a pre-filtered method, without ``compat``.
        outward: (F,) faces to cull where they face away from the light (:func:`shadowmap_dr.raster.outward_faces`).

    Values agree with :func:`shadowmap_dr.shadow.render_maps`, tangents with its derivatives.
    """
    with dr.suspend_grad():
        module = backend(views.spread)
        count, size = views.count, settings.resolution * settings.supersampling
        vertices = dr.width(p_world)
        lane = dr.arange(module.UInt32, count * vertices)
        index, vertex = split(lane, "vertices", vertices, count)
        point = module.Array3f(*(dr.gather(module.Float, p_world[c], vertex) for c in range(3)))
        view = of_map(views, index, count)
        clip = ravel(to_clip(view, of_map(frusta, index, count), to_light_space(view, point)))
        dr.eval(clip)
        # Seen from the front, outlines run clockwise: a light looks along the third of its right-handed axes.
        raster = visible_triangles(clip, faces, (size, size), batch=count, one_sided=outward)
        twist = twist_of(views)
        dr.eval(twist)
        crossings = find_crossings(clip, topology, raster, vertices) if settings.antialias else None
        rates = None if crossings is None else weight_rates(clip, crossings, frusta, twist, size)
        values, tangents = TangentTexels(raster, clip, faces, views, frusta, twist, settings, size).mixed(crossings, rates)
        dr.eval(values, tangents)
        channels = dr.width(values) // (count * size * size)
        if settings.supersampling > 1:
            values = block_means(values, size, channels, settings.supersampling)
            tangents = block_means(tangents, size, 2 * channels, settings.supersampling)
        kernel = filter_kernel(settings.filter, settings.filter_size)
        terms = separable_terms(kernel)
        if len(terms) > 1 or len(kernel) > _WIDEST_TAPS:
            shape = (count, settings.resolution, settings.resolution)
            values, tangents = filter_map(values, kernel, *shape, channels), filter_map(tangents, kernel, *shape, 2 * channels)
            dr.eval(values, tangents)
            terms = [([1.0], [1.0])]
        return TangentMaps(ShadowMaps(values, views, frusta, settings, channels), tangents, twist, terms[0])


def tangent_visibility(maps: TangentMaps, map_index: UInt32, p_world: Point3f, active: Bool) -> tuple[Float, Float, Float]:
    """(visibility, its change with a, its change with b) of world-space points. Detached.

    Args:
        maps: from :func:`tangent_maps`.
        map_index: map of each point.
        p_world: points.
        active: mask of the points to look up; the others get (1, 0, 0).
    """
    module = backend(maps.tangents)
    settings, count = maps.maps.settings, maps.maps.views.count
    views, frusta = maps.maps.views, maps.maps.frusta
    view, frustum = of_map(views, map_index, count), of_map(frusta, map_index, count)
    u, v, depth, inside = project(view, frustum, p_world)
    inside &= active & has_neighbours(settings, view, frustum, u, v)
    p = to_light_space(view, p_world)
    twist = dr.gather(module.Float, maps.twist, map_index, inside)
    per_x, per_y, per_z = dr.rcp(frustum.half_x), dr.rcp(frustum.half_y), dr.rcp(frustum.far - frustum.first)
    per_z = dr.select(depth > FAR, 0, per_z)
    depth = dr.select(depth > FAR, FAR, depth)
    moves = [(dx * per_x, dy * per_y, dz * per_z) for dx, dy, dz in turned(twist, p)]
    deviation = module.Float(depth_scale(view, frustum, depth, settings, tiled=False).deviation)
    method = PREFILTERED[settings.method]

    def look_up(index, u, v, depth, deviation, *moves):  # noqa: ANN001, ANN002, ANN202
        def resolve(values: list[Float], depth: Float) -> Float:
            value = method.resolve(values, depth, DepthScale(deviation))
            return reduced_bleeding(value, settings.bleeding) if method.bleeds else value

        # Beyond the centres of the outermost texels, look-ups are constant.
        end = float_input(module, "texels", 1 - 1 / settings.resolution)
        rates = [dr.select(dr.abs(u if k % 3 == 0 else v) > end, 0, m) if k % 3 < 2 else m for k, m in enumerate(moves)]
        at, channels = (
            Texels(maps.maps.settings.resolution, index, dr.clip(u, -end, end), dr.clip(v, -end, end)),
            maps.maps.channels,
        )
        (values, by_u, by_v), (own, _, _) = (_filtered(at, *numbers, *maps.taps) for numbers in (
            (maps.maps.values, channels), (maps.tangents, 2 * channels)
        ))  # fmt: skip
        # Texture coordinates are in texels.
        half = float_input(module, "texels", 0.5 * settings.resolution)
        value, slopes, slope_depth = _with_gradient(resolve, values, depth)
        result = [value]
        for k in range(2):
            du, dv, dz = rates[3 * k : 3 * k + 3]
            change = slope_depth * dz
            for c in range(channels):
                change += slopes[c] * (own[k * channels + c] + half * (by_u[c] * du + by_v[c] * dv))
            result.append(change)
        return tuple(result)

    return dr.if_stmt(
        (map_index, u, v, depth, deviation, *moves[0], *moves[1]),
        inside,
        look_up,
        lambda index, u, *_: (module.Float(1), module.Float(0), module.Float(0)),
        mode="symbolic",
        label="shadow look-up with tangents",
    )


def _filtered(at: Texels, flat: Float, channels: int, column: list[float], row: list[float]) -> tuple[list[Float], ...]:
    """(values, changes by column, changes by row) of filtered texels at points; the filter moves continuously with the points."""
    across, down = moved_weights(row, at.fx), moved_weights(column, at.fy)
    slope_across, slope_down = ([a - b for a, b in zip([0.0, *line], [*line, 0.0], strict=True)] for line in (row, column))
    totals: list[list[Any]] = []
    for j in range(len(down)):
        taps = [at.index(i - len(row) // 2, j - len(column) // 2) for i in range(len(across))]
        packets = [stored_texel(flat, channels, tap, True) for tap in taps]
        for k, line in enumerate(zip(*packets, strict=True)):
            value = sum(packet * weight for packet, weight in zip(line, across, strict=True))
            slope = sum(packet * weight for packet, weight in zip(line, slope_across, strict=True))
            if j == 0:
                totals.append([0, 0, 0])
            total = totals[k]
            total[0], total[1] = total[0] + value * down[j], total[1] + slope * down[j]
            total[2] = total[2] + value * slope_down[j]
    return tuple([number for total in totals for number in entries(total[kind])] for kind in range(3))


def _with_gradient(
    function: Callable[[list[Float], Float], Float], values: list[Float], depth: Float
) -> tuple[Float, list[Float], Float]:
    """``function(values, depth)`` and its derivatives by all values and by the depth."""
    with dr.resume_grad():
        inputs = [dr.detach(v) + 0 for v in (*values, depth)]
        dr.enable_grad(inputs)
        result = function(inputs[:-1], inputs[-1])
        dr.set_grad(result, 1)
        dr.enqueue(dr.ADMode.Backward, result)
        dr.traverse(dr.ADMode.Backward)
        slopes = [dr.grad(v) for v in inputs]
    return dr.detach(result), slopes[:-1], slopes[-1]

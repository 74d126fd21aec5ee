"""Maps of directional lights together with their derivatives by the lights' directions, in forward mode.

A light's direction has two degrees of freedom, and a map depends on no light but its own. So two tangents for each map and each
point that asks it are all the derivatives there are, and they need no atomic operations, no second pass over the points, and
none of the vertices' derivatives: when a light turns, points with light-space coordinates (x, y, z) move by linear functions
of these, and so does everything that lies on a triangle or an edge.

Turning by (a, b) means: the light's ``forward`` axis moves by ``a right + b up``. The other axes follow as
:func:`shadowmap_dr.shadow.directional_view` makes them, which includes a twist about ``forward`` of ``a * twist``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from ..raster import RasterOutput, Topology, visible_triangles
from ..raster._types import backend, pixel_coordinates
from ..raster.blend import Mixer
from ..raster.blend_tangents import mixed_tangents
from ..raster.crossings import Crossings, find_crossings
from ..raster.topology import NO_VERTEX
from .camera import Frusta, Views, of_map, project, to_clip, to_light_space
from .filters import filter_kernel, filter_map
from .lookup import Texels, entries, stored_texel
from .methods import PREFILTERED
from .moments import reduced_bleeding
from .shadow_map import FAR, ShadowMaps, ShadowSettings, block_means, interleaved, texel_depths


@dataclass(frozen=True)
class TangentMaps:
    """A batch of M filtered maps of directional lights and how they change when the lights turn. Detached.

    Attributes:
        maps: as :func:`shadowmap_dr.shadow.filter_maps` returns them.
        tangents: flat ``Float`` (M * N * N * 2 C): change of a texel's C numbers with a, then with b.
        twist: ``Float`` (M,).
    """

    maps: ShadowMaps
    tangents: Any
    twist: Any


def twist_of(views: Views) -> Any:
    """How much each view turns about its axis while its axis moves along ``right`` (``Float``, M)."""
    module = backend(views.spread)
    d = [dr.abs(views.forward[c]) for c in range(3)]
    # The world axis that `directional_view` starts from.
    use_x = (d[0] <= d[1]) & (d[0] <= d[2])
    use_y = ~use_x & (d[1] <= d[2])

    def component(vector: Any) -> Any:
        return dr.select(use_x, vector[0], dr.select(use_y, vector[1], vector[2]))

    return module.Float(component(views.forward) / component(views.up))


def turned(twist: Any, p: Any) -> tuple[tuple[Any, Any, Any], tuple[Any, Any, Any]]:
    """Changes of light-space coordinates (x, y, z) with a, and with b."""
    zero = type(p[0])(0)
    return (dr.fma(twist, p[1], -p[2]), -twist * p[0], p[0]), (zero, -p[2], p[1])


def tangent_maps(
    p_world: Any, faces: Any, topology: Topology, views: Views, frusta: Frusta, settings: ShadowSettings
) -> TangentMaps:
    """Render and filter maps of directional lights, with tangents.

    Args:
        p_world: ``Array3f`` (V,), vertices.
        faces: flat ``UInt32`` (3 F,), valid indices.
        topology: of the mesh.
        views, frusta: cameras of the M maps, all orthographic, with axes as :func:`directional_view` makes them.
        settings: a pre-filtered method, without ``compat``.

    Values agree with :func:`shadowmap_dr.shadow.render_maps`, tangents with its derivatives.
    """
    with dr.suspend_grad():
        module = backend(views.spread)
        count, size = views.count, settings.resolution * settings.supersampling
        vertices = dr.width(p_world)
        lane = dr.arange(module.UInt32, count * vertices)
        index = lane // vertices
        vertex = lane - index * vertices
        point = module.Array3f(*(dr.gather(module.Float, p_world[c], vertex) for c in range(3)))
        view = of_map(views, index, count)
        clip = dr.ravel(to_clip(view, of_map(frusta, index, count), to_light_space(view, point)))
        dr.eval(clip)
        raster = visible_triangles(clip, faces, (size, size), batch=count)
        twist = twist_of(views)
        dr.eval(twist)
        values, tangents, channels = _texels(raster, clip, faces, views, frusta, twist, settings, size)
        dr.eval(values, tangents)
        if settings.antialias:
            crossings = find_crossings(clip, topology, raster, vertices)
            rates = _rates(clip, crossings, frusta, twist, size)
            mixer = Mixer(values, size, crossings)
            values, tangents = mixer.values, mixed_tangents(mixer, tangents, *rates)
            dr.eval(values, tangents)
        if settings.supersampling > 1:
            values = block_means(values, size, channels, settings.supersampling)
            tangents = block_means(tangents, size, 2 * channels, settings.supersampling)
        kernel = filter_kernel(settings.filter, settings.filter_size)
        shape = (count, settings.resolution, settings.resolution)
        values, tangents = filter_map(values, kernel, *shape, channels), filter_map(tangents, kernel, *shape, 2 * channels)
        dr.eval(values, tangents)
        return TangentMaps(ShadowMaps(values, views, frusta, settings, channels), tangents, twist)


def _texels(
    raster: RasterOutput, clip: Any, faces: Any, views: Views, frusta: Frusta, twist: Any, settings: ShadowSettings, size: int
) -> tuple[Any, Any, int]:
    """Numbers to store (flat), their tangents (flat), and how many numbers there are in a texel."""
    module = backend(clip)
    image, row, column = pixel_coordinates(module, raster.batch, size, size)
    view, frustum = of_map(views, image, views.count), of_map(frusta, image, views.count)
    twist = dr.gather(module.Float, twist, image)
    texels = texel_depths(raster, clip, faces, view, frustum, views, size)
    n, f = frustum.near, frustum.far
    ndc_x = dr.fma(module.Float(column), 2.0 / size, 1.0 / size - 1.0)
    ndc_y = dr.fma(module.Float(row), 2.0 / size, 1.0 / size - 1.0)
    # The light-space point that the texel sees, and the slopes of its triangle there.
    half_range = 0.5 * (f - n)
    p = (
        dr.fma(ndc_x, frustum.half_x, frustum.center_x),
        dr.fma(ndc_y, frustum.half_y, frustum.center_y),
        dr.fma(texels.seen, half_range, 0.5 * (f + n)),
    )
    slope_x = texels.dx * half_range * (0.5 * size) / frustum.half_x
    slope_y = texels.dy * half_range * (0.5 * size) / frustum.half_y
    moves = (raster.valid & (texels.depth > -0.5)) & (texels.depth < FAR + 1)
    scale = dr.select(moves, dr.rcp(f - frustum.first), 0)
    # A texel stays where it is while the triangle moves through it.
    rates = [(dz - slope_x * dx - slope_y * dy) * scale for dx, dy, dz in turned(twist, p)]

    method = PREFILTERED[settings.method]
    values, slopes = _with_slopes(lambda z: method.encode(z, texels.slope_square, settings.order), texels.depth)
    return interleaved(values), interleaved([slope * rate for rate in rates for slope in slopes]), len(values)


def _with_slopes(function: Any, x: Any) -> tuple[list[Any], list[Any]]:
    """Several numbers and their derivatives by the one that they are functions of."""
    with dr.resume_grad():
        x = dr.detach(x, preserve_type=True) + 0
        dr.enable_grad(x)
        values = function(x)
        dr.set_grad(x, 1)
        dr.enqueue(dr.ADMode.Forward, x)
        # A number may be x itself, whose gradient would be cleared on the way.
        dr.traverse(dr.ADMode.Forward, flags=dr.ADFlag.ClearEdges)
        slopes = [dr.grad(v) for v in values]
    return [dr.detach(v) for v in values], slopes


def _rates(clip: Any, crossings: Crossings, frusta: Frusta, twist: Any, size: int) -> tuple[Any, Any]:
    """Changes with a and b (interleaved, 2 for each pixel) of the weights of right and of lower pairs; undefined for weight 0."""
    module = backend(clip)
    Array2f, Array4f = module.Array2f, module.Array4f
    count, pixels = dr.width(twist), dr.width(crossings.right)
    right, down = dr.empty(module.Float, 2 * pixels), dr.empty(module.Float, 2 * pixels)

    def visit(slot: Any, pair: Any) -> None:
        ends = dr.gather(module.Array4u, crossings.ends, slot)
        has = ends.x != NO_VERTEX
        slope = dr.gather(Array4f, crossings.slopes, slot, has)
        a, b = (dr.gather(Array4f, clip, v, has) for v in (ends.x, ends.y))
        at = dr.fma(b - a, slope.x, a)
        pixel = pair >> 1
        frustum, own = of_map(frusta, pixel // (size * size), count), dr.gather(module.Float, twist, pixel // (size * size))
        n, f = frustum.near, frustum.far
        p = (
            dr.fma(at.x, frustum.half_x, frustum.center_x),
            dr.fma(at.y, frustum.half_y, frustum.center_y),
            0.5 * dr.fma(at.z, f - n, f + n),
        )
        per_x, per_y = slope.y / frustum.half_x, slope.z / frustum.half_y
        rate = Array2f(*(dr.select(has, per_x * dx + per_y * dy, 0) for dx, dy, _ in turned(own, p)))
        is_down = (pair & 1) != 0
        dr.scatter(right, rate, pixel, ~is_down)
        dr.scatter(down, rate, pixel, is_down)

    crossings.pairs.for_each(visit)
    dr.eval(right, down)
    return right, down


def tangent_visibility(maps: TangentMaps, map_index: Any, p_world: Any, active: Any) -> tuple[Any, Any, Any]:
    """(visibility, its change with a, with b), ``Float`` each, of world-space points. Detached.

    Args:
        map_index: ``UInt32`` for each point.
        p_world: ``Array3f``.
        active: ``Bool``, points to ask for; the others get (1, 0, 0).
    """
    module = backend(maps.tangents)
    settings, count = maps.maps.settings, maps.maps.views.count
    views, frusta = maps.maps.views, maps.maps.frusta
    view, frustum = of_map(views, map_index, count), of_map(frusta, map_index, count)
    u, v, depth, inside = project(view, frustum, p_world)
    inside &= active
    p = to_light_space(view, p_world)
    twist = dr.gather(module.Float, maps.twist, map_index, inside)
    per_x, per_y, per_z = dr.rcp(frustum.half_x), dr.rcp(frustum.half_y), dr.rcp(frustum.far - frustum.first)
    per_z = dr.select(depth > FAR, 0, per_z)
    depth = dr.select(depth > FAR, FAR, depth)
    moves = [(dx * per_x, dy * per_y, dz * per_z) for dx, dy, dz in turned(twist, p)]
    method = PREFILTERED[settings.method]

    def resolve(values: list[Any], depth: Any) -> Any:
        value = method.resolve(values, depth)
        return reduced_bleeding(value, settings.bleeding) if method.bleeds else value

    def look_up(index, u, v, depth, *moves):  # noqa: ANN001, ANN002, ANN202
        at, channels = Texels(maps.maps, index, u, v), maps.maps.channels
        (values, by_u, by_v), (own, _, _) = (_bilinear(at, *numbers) for numbers in (
            (maps.maps.values, channels), (maps.tangents, 2 * channels)
        ))  # fmt: skip
        # Texture coordinates are in texels.
        half = 0.5 * settings.resolution
        value, slopes, slope_depth = _with_gradient(resolve, values, depth)
        result = [value]
        for k in range(2):
            du, dv, dz = moves[3 * k : 3 * k + 3]
            change = slope_depth * dz
            for c in range(channels):
                change += slopes[c] * (own[k * channels + c] + half * (by_u[c] * du + by_v[c] * dv))
            result.append(change)
        return tuple(result)

    Float = module.Float
    return dr.if_stmt(
        (map_index, u, v, depth, *moves[0], *moves[1]),
        inside,
        look_up,
        lambda index, u, *_: (Float(1), Float(0), Float(0)),
        mode="symbolic",
        label="shadow look-up with tangents",
    )


def _bilinear(at: Texels, flat: Any, channels: int) -> tuple[list[Any], list[Any], list[Any]]:
    """The numbers at points between texels, and their changes by column and by row."""
    corners = [[stored_texel(flat, channels, at.index(i, j), True) for i in range(2)] for j in range(2)]
    rows = [[dr.fma(b - a, at.fx, a) for a, b in zip(*row, strict=True)] for row in corners]
    steps = [[b - a for a, b in zip(*row, strict=True)] for row in corners]
    values = [dr.fma(b - a, at.fy, a) for a, b in zip(*rows, strict=True)]
    across = [dr.fma(b - a, at.fy, a) for a, b in zip(*steps, strict=True)]
    down = [b - a for a, b in zip(*rows, strict=True)]
    return tuple([number for packet in packets for number in entries(packet)] for packets in (values, across, down))


def _with_gradient(function: Any, values: list[Any], depth: Any) -> tuple[Any, list[Any], Any]:
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


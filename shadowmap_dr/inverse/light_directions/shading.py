"""Images of R runs at once, each with its own n directional lights, and the derivatives of their losses by all directions.

Lanes are runs times pixels, or runs times lights times pixels; the maps are those of all lights of all runs. The backward pass
is written by hand: the derivative of the loss passes through the anti-aliasing of the image, a sum over neighbours, and is then
multiplied by each light's tangents, which come with visibility (:mod:`shadowmap_dr.shadow.light_tangents`). Callers
suspend gradients.
"""

from __future__ import annotations

import functools
import operator
from dataclasses import replace
from typing import Any, cast

import drjit as dr
import mitsuba as mi

from ...jit.types import Bool, Float, UInt32, Vector3f, Vector4f
from ...shadow import Frusta, Views, casting_shapes, directional_view, fit_frusta, shape_bounds, to_light_space
from ...shadow.light_camera import of_map
from ...shadow.light_tangents import TangentMaps, tangent_maps, tangent_visibility
from .pixels import StillScene


def light_views(to_light: Vector3f) -> Views:
    """Cameras of M directional lights, from the directions *to* them (any length)."""
    view, count = directional_view(-mi.Vector3f(to_light)), dr.width(to_light)
    zero = dr.zeros(mi.Float, count)
    views = Views(view.right, view.up, view.forward, mi.Vector3f(zero, zero, zero), zero, zero + dr.inf)
    dr.eval(views)
    return views


def fit_maps(scene: StillScene, views: Views, previous: Frusta | None) -> Frusta:
    """Frusta of all maps, as the renderer fits them."""
    vertices = dr.width(scene.p_world)
    lane = dr.arange(mi.UInt32, views.count * vertices)
    index = lane // vertices
    vertex = lane - index * vertices
    p_light = to_light_space(of_map(views, index, views.count), dr.gather(mi.Point3f, scene.p_world, vertex))
    bounds = shape_bounds(views, p_light, index, dr.gather(mi.UInt32, scene.vertex_shape, vertex), scene.shapes)
    casts = casting_shapes(views, scene.planes, scene.planar, scene.boxes, eyes=scene.seen[2])
    s = scene.shadow
    return fit_frusta(views, bounds, casts, scene.shapes, s.resolution, s.filter_size, previous, scene.seen[:2], s.receiver_range)


def lit(scene: StillScene, views: Views, maps: TangentMaps | None) -> Float:
    """Cosine times visibility of each pixel under each light of each run, and its derivatives by both rotations of the light.

    Flat Float (4 M P), packets of four: the value, the two derivatives, zero. Pixels run fastest.
    """
    pixels = scene.pixels
    lane = dr.arange(mi.UInt32, views.count * pixels.count)
    index = lane // pixels.count
    pixel = lane - index * pixels.count
    view = of_map(views, index, views.count)

    def at(table: Vector3f) -> Vector3f:
        return mi.Vector3f(*(dr.gather(mi.Float, table[c], pixel) for c in range(3)))

    n, wo = at(pixels.n_shading), -view.forward
    cosine = dr.dot(n, wo)
    active = dr.gather(mi.Bool, pixels.active, pixel) & (cosine > 0) & (dr.dot(at(pixels.n_world), wo) > 0)
    value, by_a, by_b = mi.Float(1), mi.Float(0), mi.Float(0)
    if maps is not None:
        found = [tangent_visibility(maps, index, at(points), active) for points in pixels.points]
        sums = [functools.reduce(operator.add, (f[k] for f in found)) for k in range(3)]
        value, by_a, by_b = (total * (1 / len(found)) for total in sums)
    cosine = dr.select(active, cosine, 0)
    # As the light turns, the direction to it moves against the axes of its map.
    change_a, change_b = (dr.select(active, -dr.dot(n, axis), 0) for axis in (view.right, view.up))
    packets = mi.Vector4f(
        cosine * value, dr.fma(cosine, by_a, change_a * value), dr.fma(cosine, by_b, change_b * value), mi.Float(0)
    )
    result = cast(Float, dr.ravel(packets))
    dr.eval(result)
    return result


def images(scene: StillScene, light: Float, runs: int) -> list[Float]:
    """Anti-aliased images of all runs, one Float (R P) for each channel. ``light``: result of :func:`lit`."""
    pixels = scene.pixels
    lane = dr.arange(mi.UInt32, runs * pixels.count)
    run = lane // pixels.count
    pixel = lane - run * pixels.count
    colours = [mi.Float(0) for _ in range(pixels.channels)]
    for k in range(scene.lights):
        received = dr.gather(mi.Float, light, ((run * scene.lights + k) * pixels.count + pixel) * 4)
        for c in range(pixels.channels):
            colours[c] += received * scene.irradiance[k][c]
    colours = [total * dr.gather(mi.Float, pixels.colours[c], pixel) for c, total in enumerate(colours)]
    dr.eval(colours)
    share = dr.gather(mi.Vector4f, pixels.incoming, pixel)
    touched = cast(Float, sum(share)) > 0
    return _mixed(colours, colours, share, touched, lane, pixels.width)


def _mixed(own: list[Float], around: list[Float], share: Vector4f, active: Bool, lane: UInt32, width: int) -> list[Float]:
    """Blend of ``own`` with the four neighbours' values by their shares; ``own`` keeps the rest."""
    kept = 1 - sum(share)
    result = [kept * value for value in own]
    for k, neighbour in enumerate((lane + 1, lane + width, lane - 1, lane - width)):
        taken = active & (share[k] > 0)
        result = [dr.fma(share[k], dr.gather(mi.Float, a, neighbour, taken), r) for a, r in zip(around, result, strict=True)]
    return result


def losses_and_gradients(
    scene: StillScene, views: Views, light: Float, targets: list[Float], runs: int
) -> tuple[Float, Vector3f]:
    """Mean squared difference of each run's image from its target, and its derivatives by the directions.

    Args:
        light: result of :func:`lit`.
        targets: a Float (R P) for each channel.

    Returns:
        losses Float (R,), and Vector3f (M,): derivatives of a run's loss by the unit vectors to its lights, in their tangent
        planes.
    """
    pixels = scene.pixels
    lane = dr.arange(mi.UInt32, runs * pixels.count)
    pixel = lane % pixels.count
    differences = [image - target for image, target in zip(images(scene, light, runs), targets, strict=True)]
    dr.eval(differences)
    number = pixels.count * pixels.channels
    losses = dr.block_sum(cast(Float, sum(dr.square(d) for d in differences)), pixels.count) * (1 / number)

    # Back through the anti-aliasing: the shares of a pixel in its neighbours, and in itself.
    kept = 1 - sum(dr.gather(mi.Vector4f, pixels.incoming, pixel))
    given = dr.gather(mi.Vector4f, pixels.outgoing, pixel)
    adjoint = [kept * d for d in differences]
    for k, neighbour in enumerate((lane + 1, lane + pixels.width, lane - 1, lane - pixels.width)):
        taken = given[k] > 0
        adjoint = [
            dr.fma(given[k], dr.gather(mi.Float, d, neighbour, taken), a) for d, a in zip(differences, adjoint, strict=True)
        ]
    adjoint = [a * dr.gather(mi.Float, pixels.colours[c], pixel) * (2 / number) for c, a in enumerate(adjoint)]
    gradients = []
    for k in range(scene.lights):
        weight = sum(a * scene.irradiance[k][c] for c, a in enumerate(adjoint))
        run = lane // pixels.count
        changes = dr.gather(mi.Vector4f, light, (run * scene.lights + k) * pixels.count + pixel)
        gradients.append([dr.block_sum(weight * changes[1 + j], pixels.count) for j in range(2)])
    # Lights of a run lie side by side.
    index = dr.arange(mi.UInt32, views.count)
    run = index // scene.lights
    dr.eval(losses, gradients)
    by_a, by_b = mi.Float(0), mi.Float(0)
    for k, (a, b) in enumerate(gradients):
        own = index - run * scene.lights == k
        by_a, by_b = by_a + dr.gather(mi.Float, a, run, own), by_b + dr.gather(mi.Float, b, run, own)
    return losses, -(views.right * by_a + views.up * by_b)


def render_lights(scene: StillScene, to_light: Vector3f, frusta: Frusta | None) -> tuple[Views, Float, Frusta | None]:
    """(cameras, result of :func:`lit`, new frusta) for the directions to M lights, those of run 0 first."""
    views = light_views(to_light)
    if scene.shadow.method == "none":
        return views, lit(scene, views, None), frusta
    frusta = fit_maps(scene, views, frusta)
    maps = tangent_maps(scene.p_world, scene.faces, scene.topology, views, frusta, scene.shadow, scene.outward)
    return views, lit(scene, views, maps), maps.maps.frusta


def with_shadow(scene: StillScene, **changes: Any) -> StillScene:  # Any: values of settings
    """The same scene with other shadow settings, by their names in `ShadowSettings`."""
    return replace(scene, shadow=replace(scene.shadow, **changes))

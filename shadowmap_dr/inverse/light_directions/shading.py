"""Images of R runs at once, each with n directional lights of its own, and the derivatives of their losses by all directions.

Lanes are runs times pixels, and runs times lights times pixels; maps are those of all lights of all runs. What the image loses
against its target is passed back through the anti-aliasing of the image, a sum over neighbours; from there on each light's
derivatives are known already, since visibility comes with its tangents (:mod:`shadowmap_dr.shadow.light_tangents`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ...shadow import Frusta, Views, casting_shapes, directional_view, fit_frusta, shape_bounds, to_light_space
from ...shadow.light_camera import of_map
from ...shadow.light_tangents import TangentMaps, tangent_maps, tangent_visibility
from .pixels import StillScene


def light_views(to_light: Any) -> Views:
    """Cameras of directional lights, given the directions *to* them (Vector3f, M, any length)."""
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
    casts = casting_shapes(views, scene.planes, scene.planar, scene.boxes)
    s = scene.shadow
    return fit_frusta(views, bounds, casts, scene.shapes, s.resolution, s.filter_size, previous, scene.seen, s.receiver_range)


def lit(scene: StillScene, views: Views, maps: TangentMaps | None) -> Any:
    """Cosine times visibility of each pixel under each light of each run, and its changes as the light turns by a and by b.

    Flat Float (4 M P), packets of four: the value, both changes, nothing. Pixels run fastest.
    """
    pixels = scene.pixels
    lane = dr.arange(mi.UInt32, views.count * pixels.count)
    index = lane // pixels.count
    pixel = lane - index * pixels.count
    view = of_map(views, index, views.count)

    def at(table: Any) -> Any:
        return mi.Vector3f(*(dr.gather(mi.Float, table[c], pixel) for c in range(3)))

    n, wo = at(pixels.n_shading), -view.forward
    cosine = dr.dot(n, wo)
    active = dr.gather(mi.Bool, pixels.active, pixel) & (cosine > 0) & (dr.dot(at(pixels.n_world), wo) > 0)
    value, by_a, by_b = mi.Float(1), mi.Float(0), mi.Float(0)
    if maps is not None:
        found = [tangent_visibility(maps, index, at(points), active) for points in pixels.points]
        value, by_a, by_b = (sum(f[k] for f in found) * (1 / len(found)) for k in range(3))
    cosine = dr.select(active, cosine, 0)
    # The direction to the light moves against the axis of its map.
    change_a, change_b = (dr.select(active, -dr.dot(n, axis), 0) for axis in (view.right, view.up))
    result = mi.Vector4f(
        cosine * value, dr.fma(cosine, by_a, change_a * value), dr.fma(cosine, by_b, change_b * value), mi.Float(0)
    )
    result = dr.ravel(result)
    dr.eval(result)
    return result


def images(scene: StillScene, light: Any, runs: int) -> list[Any]:
    """Anti-aliased images of all runs, one Float (R P) for each channel, from what :func:`lit` returns."""
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
    touched = sum(share) > 0
    return _mixed(colours, colours, share, touched, lane, pixels.width)


def _mixed(own: list[Any], around: list[Any], share: Any, active: Any, lane: Any, width: int) -> list[Any]:
    """``own`` and the four neighbours' values by their shares: each share is taken from ``own``."""
    kept = 1 - sum(share)
    result = [kept * value for value in own]
    for k, neighbour in enumerate((lane + 1, lane + width, lane - 1, lane - width)):
        taken = active & (share[k] > 0)
        result = [dr.fma(share[k], dr.gather(mi.Float, a, neighbour, taken), r) for a, r in zip(around, result, strict=True)]
    return result


def losses_and_gradients(scene: StillScene, views: Views, light: Any, targets: Any, runs: int) -> tuple[Any, Any]:
    """Mean squared difference of each run's image from its target (Float, R), and its derivatives by the directions.

    Args:
        light: from :func:`lit`.
        targets: for each channel a Float (R P).

    Returns:
        losses, and Vector3f (M,): derivative of the run's loss by a unit vector to each light, in its tangent plane.
    """
    pixels = scene.pixels
    lane = dr.arange(mi.UInt32, runs * pixels.count)
    pixel = lane % pixels.count
    differences = [image - target for image, target in zip(images(scene, light, runs), targets, strict=True)]
    dr.eval(differences)
    number = pixels.count * pixels.channels
    losses = dr.block_sum(sum(dr.square(d) for d in differences), pixels.count) * (1 / number)

    # Back through the mixing of pixels: what a pixel gave to its neighbours, and what it kept.
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


def render_lights(scene: StillScene, to_light: Any, frusta: Frusta | None) -> tuple[Views, Any, Frusta | None]:
    """(cameras, what :func:`lit` returns, frusta) for directions to M lights (Vector3f): those of run 0 first."""
    views = light_views(to_light)
    if scene.shadow.method == "none":
        return views, lit(scene, views, None), frusta
    frusta = fit_maps(scene, views, frusta)
    maps = tangent_maps(scene.p_world, scene.faces, scene.topology, views, frusta, scene.shadow, scene.outward)
    return views, lit(scene, views, maps), maps.maps.frusta


def with_shadow(scene: StillScene, **changes: Any) -> StillScene:
    """The same scene with other shadows."""
    return replace(scene, shadow=replace(scene.shadow, **changes))

"""Light that surfaces reflect once, emit, or that environments send to the camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from ..jit.broadcast import broadcast_differentiable
from ..jit.handover import stored
from ..jit.types import Bool, Color3f, Float, Vector3f
from ..scene.lights.area import AreaLight
from ..scene.lights.environment import Environment, UniformRadiance
from ..scene.lights.read import Light
from ..scene.sensor import Sensor
from ..scene.sums import evaluate
from .gbuffer.surface import Surface


def direct_light(
    surface: Surface,
    light: Light,
    visibility: Float | Color3f | float = 1.0,
    nodes: Sequence[Any] = (),
    *,
    gate: bool = True,
    keep: bool = False,
) -> Color3f:
    """Radiance (colour, N) of one light towards the camera: BSDF * light * visibility.

    ``visibility`` Float or colour (N,), 0 dark to 1 lit. ``nodes``: :attr:`SceneData.materials`. ``gate`` removes light from
    directions in front of the shading normal but behind the triangle, as a shadow ray would. ``keep``: store for derivatives what
    materials that depend on directions reflect. Gradients flow to surface, light and visibility, not through the gate.
    """
    wo_world, weight = broadcast_differentiable(light, dr.width(surface.shape)).illuminate(surface.p_world, surface.active)
    wo = surface.si.to_local(wo_world)
    active = mi.Bool(surface.active)
    if gate:
        active &= passes_gate(surface, wo_world, wo)
    reflected = _reflected(surface, wo, active, nodes)
    if keep and surface.colour is None:
        reflected = stored("reflected", reflected, beside=(weight, visibility))
    return dr.select(active, reflected * weight * visibility, 0.0)


def _reflected(surface: Surface, wo: Vector3f, active: Bool, nodes: Sequence[Any]) -> Color3f:
    """:meth:`Surface.evaluate` with accurate sums of derivatives by the parameters of ``nodes``."""
    if surface.colour is not None:
        return surface.evaluate(wo, active)
    return evaluate(lambda own: own[0].evaluate(*own[1:]), (surface, wo, mi.Bool(active)), nodes, dr.width(surface.shape))


def passes_gate(surface: Surface, wo_world: Vector3f, wo: Vector3f) -> Bool:
    """Mask (Bool, N) of directions for which triangle and shading normal agree. ``wo``: ``wo_world`` in the shading frame."""
    # They agree if light and viewer are on the same side of both or on opposite sides of both. This covers reflection and
    # transmission, and triangles whose vertex normals point to the other side.
    with dr.suspend_grad():
        sides = dr.dot(surface.n_world, wo_world) * dr.dot(surface.n_world, surface.wi_world)
        return (sides > 0) == (wo.z * surface.si.wi.z > 0)


def emission(surface: Surface, lights: Sequence[AreaLight]) -> Color3f:
    """Radiance (colour, N) that surfaces emit towards the camera. Attached to surface and lights.

    Faces shine on the side of their vertex normals. Mitsuba tests the interpolated normal itself, which turns away before the
    silhouette of a smooth shape: the dark rim would hide the silhouette, and with it the derivatives of a moving lamp.
    """
    total = dr.zeros(mi.UnpolarizedSpectrum, dr.width(surface.shape))
    front = shining_side(surface)
    si = mi.SurfaceInteraction3f(surface.si)
    si.wi = mi.Vector3f(0, 0, 1)
    for light in lights:
        own = front & (surface.shape == light.shape)
        radiance = evaluate(partial(_seen, light), (si, own), [light.emitter], dr.width(surface.shape))
        total += dr.select(own, radiance, 0)
    return total


def _seen(light: AreaLight, at: tuple[mi.SurfaceInteraction3f, Bool]) -> Color3f:
    return light.seen(*at)


def shining_side(surface: Surface) -> Bool:
    """Mask (Bool, N) of surfaces whose side with the vertex normals the camera sees."""
    with dr.suspend_grad():
        towards = dr.dot(surface.n_world, surface.wi_world) * dr.dot(surface.n_world, surface.si.sh_frame.n)
        return surface.active & (towards > 0)


def ambient_light(
    surface: Surface, environment: Environment | UniformRadiance, n_directions: int = 16, nodes: Sequence[Any] = ()
) -> Color3f:
    """Radiance (colour, N) towards the camera of an environment that nothing shadows.

    A fixed set of ``n_directions`` cosine-distributed directions in the hemisphere of the shading normal on the viewer's side
    (Fibonacci spiral): exact for diffuse surfaces under constant light, coarse for gloss. Gradients flow to surface and emitter.
    ``nodes``: :attr:`SceneData.materials`.
    """
    total = dr.zeros(mi.UnpolarizedSpectrum, dr.width(surface.shape))
    side = dr.select(surface.si.wi.z < 0, -1.0, mi.Float(1.0))
    for i in range(n_directions):
        radius = math.sqrt((i + 0.5) / n_directions)
        angle = i * math.pi * (3.0 - math.sqrt(5.0))
        cosine = math.sqrt(1.0 - radius * radius)
        wo = mi.Vector3f(radius * math.cos(angle), radius * math.sin(angle), cosine * side)
        radiance = environment.radiance(surface.si.to_world(wo), surface.active)
        total += _reflected(surface, wo, surface.active, nodes) * radiance * (math.pi / (cosine * n_directions))
    return dr.select(surface.active, total, 0.0)


def background(environment: Environment, sensor: Sensor, width: int | None = None, height: int | None = None) -> Color3f:
    """Unoccluded radiance (colour, H * W) of an environment at every pixel centre."""
    towards = sensor.ray_direction(width, height)
    return evaluate(environment.radiance, towards, environment.nodes, dr.width(towards))

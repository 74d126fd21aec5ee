"""Reflected light of extended lights: a sum over their samples, in one loop on the device."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from ...jit.kernel_inputs import split
from ...jit.types import Color3f, Float, PyTree, UInt32, Vector3f
from ...scene.mitsuba_objects import transmits
from ...scene.sensor import ImageSize
from ...scene.sums import attached_parameters, sum_over
from ...shadow import transmittance
from ..direct_light import passes_gate
from ..gbuffer.surface import Surface
from ..shadow_pass import share_through
from .interleaving import Interleaving
from .penumbra import penumbra_visibility
from .sample_maps import SoftMaps, SoftPlan, map_of
from .samples import LightSamples
from .sky_light import reflects_only, sky_light
from .sky_samples import SkySamples


def soft_light(
    seen: Surface,
    plan: SoftPlan,
    samples: LightSamples,
    maps: SoftMaps | None,
    nodes: Sequence[Any],
    interleaving: Interleaving,
    *,
    gate: bool = True,
    visible: Float | Color3f | None = None,
) -> Color3f:
    """Radiance (colour, P) towards the camera of one extended light.

    ``maps`` None: unshadowed. ``nodes``: all BSDFs that ``seen`` may call, and shapes whose
    attributes these read. ``gate``: see :func:`shadowmap_dr.rendering.direct_light.direct_light`. ``visible``: from
    :func:`sample_visibilities`, to be looked up instead of the maps. ``interleaving``: from :func:`interleaving_of`.
    Gradients flow to all of surface, samples, maps and BSDFs.
    """
    if isinstance(samples, SkySamples) and reflects_only(nodes):
        return sky_light(seen, plan, samples, maps, nodes, gate=gate, visible=visible)
    sampled = None if maps is None or plan.kind == "single" else maps.sampled
    two_sided = not samples.distant and any(transmits(node) for node in nodes)

    def one_sample(number: UInt32, own: PyTree, shared: PyTree) -> Color3f:
        (seen, lane, group), (table, maps, visible) = own, shared
        index = interleaving.point(number, group)
        value, active = mi.UnpolarizedSpectrum(0), mi.Bool(False)
        for wo_world, weight, reached in table.illuminate(index, seen.p_world, sides(seen)):
            wo = seen.si.to_local(wo_world)
            passes = seen.active & reached
            if gate:
                passes &= passes_gate(seen, wo_world, wo)
            value += dr.select(passes, seen.evaluate(wo, passes) * weight, 0)
            active |= passes
        if visible is not None:
            value *= dr.gather(type(visible), visible, number * lanes + lane, active)
        elif maps is not None:
            value *= share_through(maps, map_of(plan, table, index, seen.p_world, maps), seen.p_world, active)
        return dr.select(active, value, 0)

    def sides(seen: Surface) -> list[Vector3f]:
        """Normals on the sides of the surface that light may come from."""
        n = seen.si.sh_frame.n
        above = mi.Vector3f(dr.select(dr.detach(seen.si.wi.z) < 0, -n, n))
        return [above, -above] if two_sided else [above]

    lanes = dr.width(seen.shape)
    start = dr.zeros(mi.UnpolarizedSpectrum, lanes)
    implicit = [] if seen.colour is not None else attached_parameters(nodes)
    own = seen, None if visible is None else dr.arange(mi.UInt32, lanes), interleaving.group
    shared = samples.table(), sampled, visible
    light = sum_over(one_sample, interleaving.seen, start, own, shared, implicit, seen.active)
    if interleaving.groups > 1:
        light *= interleaving.groups
    if maps is None or maps.single is None or plan.kind != "single":
        return light
    radius = samples.radius_towards(seen.p_world)
    which, single = mi.UInt32(plan.first), maps.single.maps
    light *= penumbra_visibility(maps.single, which, radius, seen.p_world, seen.n_world, seen.active)
    if single.transmittance is None:
        return light
    return light * mi.UnpolarizedSpectrum(*transmittance(single, which, seen.p_world, seen.active))


def interleaving_of(samples: LightSamples, size: ImageSize, factor: int, images: int = 1) -> Interleaving:
    """Interleaving of an image's samples over the points of an area light. All samples see all parts of the sky.

    ``size``: samples of the image; ``factor``: samples along each side of a pixel.
    """
    return Interleaving(samples.count) if samples.distant else Interleaving.of(samples.count, size, factor, images)


def sample_visibilities(
    seen: Surface, plan: SoftPlan, samples: LightSamples, maps: SoftMaps | None, interleaving: Interleaving
) -> Float | Color3f | None:
    """Visibility (Float, K P) of the K samples of an extended light, sample by sample, or None without maps of samples.

    A colour instead of a number with translucent casters.

    With several groups of samples: of the points that each lane sees. Detached. For images that differ only in materials and in
    the colours of lights.
    """
    if maps is None or maps.sampled is None or plan.kind == "single":
        return None
    with dr.suspend_grad():
        count, table = dr.width(seen.shape), samples.table()
        lane = dr.arange(mi.UInt32, interleaving.seen * count)
        number, pixel = split(lane, "pixels", count, interleaving.seen)
        dr.eval(seen.p_world, seen.active, interleaving.group)
        group = None if interleaving.group is None else dr.gather(mi.UInt32, interleaving.group, pixel)
        sample = interleaving.point(number, group)
        p_world, active = dr.gather(mi.Point3f, seen.p_world, pixel), dr.gather(mi.Bool, seen.active, pixel)
        found = share_through(maps.sampled, map_of(plan, table, sample, p_world, maps.sampled), p_world, active)
        dr.eval(found)
        return found

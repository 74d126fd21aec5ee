"""Reflected light of an environment: a sum over the parts of the sky. A surface's horizon may hide a share of a part."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from ...jit.types import ArrayXf, Color3f, Float, PyTree, UInt32
from ...jit.vectors import mean_of
from ...scene.mitsuba_objects import transmits
from ...scene.sums import attached_parameters, sum_over
from ..direct_light import passes_gate
from ..gbuffer.surface import Surface
from ..shadow_pass import share_through
from .sample_maps import SoftMaps, SoftPlan, map_of
from .sky_samples import SkySamples

# Shadows near the horizon are measured up to so many half-widths of a part above it.
_LOW = 3.0


def reflects_only(nodes: Sequence[Any]) -> bool:
    """True if none of the BSDFs among ``nodes`` spreads light to its other side."""
    return not any(transmits(node) for node in nodes)


def sky_light(
    seen: Surface,
    plan: SoftPlan,
    samples: SkySamples,
    maps: SoftMaps | None,
    nodes: Sequence[Any],
    *,
    gate: bool = True,
    visible: Float | Color3f | None = None,
) -> Color3f:
    """Radiance (colour, P) towards the camera of an environment, on surfaces that reflect only.

    Arguments and gradients as of :func:`~shadowmap_dr.rendering.extended_lights.shading.soft_light`.

    A part of the sky gives the mean of its cosines, not the cosine of its middle. If it lies across the horizon, only the upper
    share counts, from the direction of its own middle. That is more light than the cosine of the whole part's middle gives, or
    light where that gives none. The shadow map of such a part looks along the surface, or comes from behind it, and says little:
    this additional light is as visible as what comes from other parts low above the horizon.
    """
    channels, lanes = dr.size_v(mi.UnpolarizedSpectrum), dr.width(seen.shape)

    def one_part(index: UInt32, own: PyTree, shared: PyTree) -> ArrayXf:
        (seen, lane), (table, widths, maps, known) = own, shared
        towards, power = table.from_sky(index)
        side = dr.select(seen.si.wi.z < 0, mi.Float(-1), 1)
        length, half = widths.of(index, mi.Vector3f(seen.si.sh_frame.n))
        wo = seen.si.to_local(towards)
        height = side * wo.z * length
        # -1 where the part touches the horizon from below, 1 where it does from above.
        place = dr.clip(height * dr.rcp(half), -1, 1)
        whole = dr.detach(place) >= 1
        bent = 0.5 * half * (1 + place) * dr.rcp(length)
        across = dr.sqrt(dr.maximum(1 - dr.square(bent), 0) * dr.rcp(dr.maximum(dr.square(wo.x) + dr.square(wo.y), 1e-6)))
        wo = dr.select(whole, wo, mi.Vector3f(wo.x * across, wo.y * across, side * bent))
        active = seen.active & (dr.detach(place) > -1)
        if gate:
            active &= passes_gate(seen, seen.si.to_world(wo), wo)
        value = dr.select(active, seen.evaluate(wo, active) * power * length, 0)
        # Shares of the value that the middle's own cosine makes, and that come in addition.
        upper = dr.maximum(place, 0)
        inner = value * (2 * upper * dr.rcp(1 + upper))
        further = value * dr.select(dr.detach(place) > 0, dr.square(1 - place) * dr.rcp(2 * (1 + upper)), 0.5 * (1 + place))
        above = dr.detach(height) > 0
        low = dr.maximum(height * (1 - height * dr.rcp(_LOW * half)), 0)
        visible: Float | Color3f = mi.Float(1)
        lit = active & above
        if known is not None:
            visible = dr.gather(type(known), known, index * lanes + lane, lit)
        elif maps is not None:
            visible = dr.select(lit, share_through(maps, map_of(plan, table, index, seen.p_world, maps), seen.p_world, lit), 0)
        sums = [*(inner * visible), *further, low * mean_of(visible), low]
        return mi.ArrayXf([mi.Float(dr.select(seen.active, x, 0)) for x in sums])

    implicit = [] if seen.colour is not None else attached_parameters(nodes)
    shared = (samples.table(), samples.widths(), None if maps is None else maps.sampled, visible)
    own = seen, None if visible is None else dr.arange(mi.UInt32, lanes)
    start = dr.zeros(mi.ArrayXf, (2 * channels + 2, lanes))
    sums = sum_over(one_part, samples.count, start, own, shared, implicit, seen.active)
    if dr.grad_enabled(sums):
        dr.eval(sums)  # derivatives of what follows need them, and would run the loop once more
    inner, further = (mi.UnpolarizedSpectrum(*(sums[first + c] for c in range(channels))) for first in (0, channels))
    lit, low = sums[2 * channels], sums[2 * channels + 1]
    some = dr.detach(low) > 0
    return inner + further * dr.select(some, lit * dr.rcp(dr.select(some, low, 1)), 0)

"""Light of extended lights on what is seen: a sum over their samples, in one loop on the device."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from ..shading import Surface, passes_gate
from ..shadow import ShadowMaps, visibility
from .maps import SoftPlan, map_of
from .samples import LightSamples


def soft_light(seen: Surface, plan: SoftPlan, samples: LightSamples, maps: ShadowMaps | None, *, gate: bool = True) -> Any:
    """Radiance (colour, P) towards the camera of one extended light.

    ``maps`` None: unshadowed. ``gate``: see :func:`shadowmap_dr.shading.direct_light`. Gradients flow to all of surface, samples
    and maps. The loop keeps nothing of its iterations for the way back: they are run once more there.
    """
    table = samples.table()
    lanes = dr.width(seen.shape)

    def body(index: Any, total: Any) -> tuple[Any, Any]:
        wo_world, weight = table.illuminate(index, seen.p_world)
        wo = seen.si.to_local(wo_world)
        active = seen.active & (dr.max(dr.detach(weight)) > 0)
        if gate:
            active &= passes_gate(seen, wo_world, wo)
        value = seen.evaluate(wo, active) * weight
        if maps is not None:
            value *= visibility(maps, map_of(plan, table, index, seen.p_world), seen.p_world, active)
        return index + 1, total + dr.select(active, value, 0)

    start = (dr.zeros(mi.UInt32, lanes), dr.zeros(mi.UnpolarizedSpectrum, lanes))
    _, total = dr.while_loop(
        start,
        lambda index, total: index < table.count,
        body,
        mode="symbolic",
        # Iterations depend on each other through the sum only: Dr.Jit's way back needs no memory then.
        max_iterations=-1,
        label="soft light",
    )
    return total

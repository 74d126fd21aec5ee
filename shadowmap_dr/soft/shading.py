"""Light of extended lights on what is seen: a sum over their samples, in one loop on the device."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from ..records import attached_arrays, with_arrays
from ..shading import Surface, passes_gate
from ..shadow import visibility
from ..traversal import parameters
from .maps import SoftMaps, SoftPlan, map_of
from .penumbra import penumbra_visibility
from .samples import LightSamples


def soft_light(
    seen: Surface,
    plan: SoftPlan,
    samples: LightSamples,
    maps: SoftMaps | None,
    bsdfs: Sequence[Any],
    *,
    gate: bool = True,
) -> Any:
    """Radiance (colour, P) towards the camera of one extended light.

    ``maps`` None: unshadowed. ``bsdfs``: all that ``seen`` may call. ``gate``: see :func:`shadowmap_dr.shading.direct_light`.
    Gradients flow to all of surface, samples, maps and BSDFs.
    """
    sampled = None if maps is None or plan.kind == "single" else maps.sampled
    inputs = (seen, samples.table(), sampled)

    def one_sample(index: Any, arrays: list[Any]) -> Any:
        seen, table, maps = with_arrays(inputs, arrays)
        wo_world, weight = table.illuminate(index, seen.p_world)
        wo = seen.si.to_local(wo_world)
        active = seen.active & (dr.max(dr.detach(weight)) > 0)
        if gate:
            active &= passes_gate(seen, wo_world, wo)
        value = seen.evaluate(wo, active) * weight
        if maps is not None:
            value *= visibility(maps, map_of(plan, table, index, seen.p_world), seen.p_world, active)
        return dr.select(active, value, 0)

    light = sum_over(one_sample, samples.count, dr.width(seen.shape), attached_arrays(inputs), _attached_parameters(bsdfs))
    if maps is None or plan.kind != "single":
        return light
    radius = samples.radius_towards(seen.p_world)
    return light * penumbra_visibility(maps.single, mi.UInt32(plan.first), radius, seen.p_world, seen.n_world, seen.active)


def _attached_parameters(bsdfs: Sequence[Any]) -> list[Any]:
    """What BSDFs hold that gradients may flow to."""
    found = []
    for bsdf in dict.fromkeys(bsdfs):
        found += [v for v in parameters(bsdf).values() if dr.is_array_v(v) and dr.is_float_v(v) and dr.grad_enabled(v)]
    return found


def sum_over(term: Callable[[Any, list[Any]], Any], count: int, lanes: int, arrays: list[Any], implicit: list[Any]) -> Any:
    """Sum of ``term(index, arrays)`` (colour, one entry a lane) over the indices below ``count``.

    Terms are worked out once more for derivatives, instead of being kept. Gradients flow to ``arrays``, which ``term`` must take
    from its argument, and to ``implicit``, which it reaches by itself.
    """
    if not arrays and not implicit:
        return _loop(lambda index: term(index, arrays), count, lanes)
    return dr.custom(_Sum, arrays, implicit, term, count, lanes)


def _loop(term: Callable[[Any], Any], count: int, lanes: int, label: str = "soft light") -> Any:
    _, total = dr.while_loop(
        (dr.zeros(mi.UInt32, lanes), dr.zeros(mi.UnpolarizedSpectrum, lanes)),
        lambda index, total: index < count,
        lambda index, total: (index + 1, total + term(index)),
        mode="symbolic",
        # Iterations depend on each other through the sum only: Dr.Jit's way back needs no memory then.
        max_iterations=-1,
        label=label,
    )
    return total


class _Sum(dr.CustomOp):
    """The loop with derivatives of its own: Dr.Jit 1.5 fails in forward mode where a loop reads what others read too."""

    def eval(self, arrays: list[Any], implicit: list[Any], term: Any, count: int, lanes: int) -> Any:
        self._arrays = arrays
        self._call = (term, count, lanes)
        self.add_input(implicit)
        term_of = self._call[0]
        return _loop(lambda index: term_of(index, arrays), count, lanes)

    def forward(self) -> None:
        term, count, lanes = self._call
        leaves = self._leaves()
        tangents = self.grad_in("arrays")
        dr.eval(tangents)
        for leaf, tangent in zip(leaves, tangents, strict=True):
            dr.set_grad(leaf, tangent)

        def change(index: Any) -> Any:
            with dr.resume_grad():
                value = term(index, leaves)
                dr.forward_to(value, flags=dr.ADFlag.ClearInterior | dr.ADFlag.ClearEdges)
            return dr.grad(value)

        self.set_grad_out(_loop(change, count, lanes, "soft light, forward"))

    def backward(self) -> None:
        term, count, lanes = self._call
        leaves = self._leaves()
        with dr.resume_grad():
            total = _loop(lambda index: term(index, leaves), count, lanes)
            dr.backward_from(total * self.grad_out())
        self.set_grad_in("arrays", [dr.grad(leaf) for leaf in leaves])

    def _leaves(self) -> list[Any]:
        leaves = [type(array)(dr.detach(array)) for array in self._arrays]
        dr.enable_grad(leaves)
        return leaves

    def name(self) -> str:
        return "soft light"

"""Sums of many terms in one loop on the device, differentiable in both modes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi


def sum_over(
    term: Callable[[Any, list[Any]], Any],
    count: int,
    zero: Any,
    arrays: list[Any],
    implicit: list[Any],
    lanes: int,
    active: Any = True,
) -> Any:
    """Sum of ``term(index, arrays)`` (of the type and width of ``zero``) over the indices (UInt32) below ``count``.

    Terms are worked out once more for derivatives, instead of being kept. Gradients flow to ``arrays``, which ``term`` must take
    from its argument, and to ``implicit``, which it reaches by itself. The first ``lanes`` arrays are as wide as ``zero`` (or of
    width 1), and each lane uses its own numbers; from the others it gathers. Lanes that are not ``active`` (Bool) keep ``zero``,
    and cost nothing where all their neighbours are not, either.
    """
    active = dr.detach(mi.Bool(active))
    if not arrays and not implicit:
        return _loop(lambda index: term(index, arrays), count, zero, active)
    return dr.custom(_Sum, arrays, implicit, lanes, term, count, zero, active)


def _loop(term: Callable[[Any], Any], count: int, zero: Any, active: Any, label: str = "soft light") -> Any:
    _, total = dr.while_loop(
        (dr.zeros(mi.UInt32, dr.width(zero)), type(zero)(zero)),
        lambda index, total: active & (index < count),
        lambda index, total: (index + 1, total + term(index)),
        mode="symbolic",
        label=label,
    )
    return total


class _Sum(dr.CustomOp):
    """The loop with derivatives of its own.

    Dr.Jit 1.5 fails in forward mode where a loop reads what others read too, and backwards where terms call BSDFs of Mitsuba's.
    """

    def eval(
        self, arrays: list[Any], implicit: list[Any], lanes: int, term: Any, count: int, zero: Any, active: Any
    ) -> Any:
        self._arrays, self._lanes = arrays, lanes
        self._call = (term, count, zero, active)
        self.add_input(implicit)
        return _loop(lambda index: term(index, arrays), count, zero, active)

    def forward(self) -> None:
        term, count, zero, active = self._call
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

        self.set_grad_out(_loop(change, count, zero, active, "soft light, forward"))

    def backward(self) -> None:
        term, count, zero, active = self._call
        leaves, gradient = self._leaves(), self.grad_out()
        width = dr.width(zero)
        # A lane's part of these is added up from term to term; the others receive theirs where the terms gather from them.
        own = leaves[: self._lanes]
        wide = [dr.repeat(dr.detach(leaf), width // dr.width(leaf)) for leaf in own]
        dr.eval(wide, gradient)

        def add(index: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            with dr.resume_grad():
                mine = [type(array)(array) for array in wide]
                dr.enable_grad(mine)
                dr.backward_from(term(index, mine + leaves[self._lanes :]) * gradient)
            return index + 1, [total + dr.grad(array) for total, array in zip(sums, mine, strict=True)]

        start = [dr.zeros(type(array), width) for array in wide]
        _, sums = dr.while_loop(
            (dr.zeros(mi.UInt32, width), start),
            lambda index, sums: active & (index < count),
            add,
            mode="symbolic",
            label="soft light, backward",
        )
        gathered = [dr.grad(leaf) for leaf in leaves[self._lanes :]]
        # What lanes add up, and what they send elsewhere, in one pass of the loop: it would run once for each.
        dr.eval(sums, gathered)
        sums = [dr.block_sum(total, width // dr.width(leaf)) for total, leaf in zip(sums, own, strict=True)]
        self.set_grad_in("arrays", sums + gathered)

    def _leaves(self) -> list[Any]:
        leaves = [type(array)(dr.detach(array)) for array in self._arrays]
        dr.enable_grad(leaves)
        return leaves

    def name(self) -> str:
        return "soft light"

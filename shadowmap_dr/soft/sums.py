"""Sums of many terms in one loop on the device, differentiable in both modes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi


def sum_over(term: Callable[[Any, list[Any]], Any], count: int, zero: Any, arrays: list[Any], implicit: list[Any]) -> Any:
    """Sum of ``term(index, arrays)`` (of the type and width of ``zero``) over the indices (UInt32) below ``count``.

    Terms are worked out once more for derivatives, instead of being kept. Gradients flow to ``arrays``, which ``term`` must take
    from its argument, and to ``implicit``, which it reaches by itself.
    """
    if not arrays and not implicit:
        return _loop(lambda index: term(index, arrays), count, zero)
    return dr.custom(_Sum, arrays, implicit, term, count, zero)


def _loop(term: Callable[[Any], Any], count: int, zero: Any, label: str = "soft light") -> Any:
    _, total = dr.while_loop(
        (dr.zeros(mi.UInt32, dr.width(zero)), type(zero)(zero)),
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

    def eval(self, arrays: list[Any], implicit: list[Any], term: Any, count: int, zero: Any) -> Any:
        self._arrays = arrays
        self._call = (term, count, zero)
        self.add_input(implicit)
        return _loop(lambda index: term(index, arrays), count, zero)

    def forward(self) -> None:
        term, count, zero = self._call
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

        self.set_grad_out(_loop(change, count, zero, "soft light, forward"))

    def backward(self) -> None:
        term, count, zero = self._call
        leaves = self._leaves()
        with dr.resume_grad():
            total = _loop(lambda index: term(index, leaves), count, zero)
            dr.backward_from(total * self.grad_out())
        self.set_grad_in("arrays", [dr.grad(leaf) for leaf in leaves])

    def _leaves(self) -> list[Any]:
        leaves = [type(array)(dr.detach(array)) for array in self._arrays]
        dr.enable_grad(leaves)
        return leaves

    def name(self) -> str:
        return "soft light"

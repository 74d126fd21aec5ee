"""Sums of large terms, one in memory at a time. Derivatives compute each term once more."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr

from .pytree import attached_copies, attached_places, tree_map, with_places
from .types import AnyArray, PyTree

#: A term of a sum: (arrays that are summed over all terms, arrays of this term's own).
Term = tuple[list[AnyArray], list[AnyArray]]


def checkpointed_sum(
    term: Callable[[int, PyTree], Term], count: int, tree: PyTree, implicit: Sequence[AnyArray] = ()
) -> tuple[list[AnyArray], list[list[AnyArray]]]:
    """Sum of ``term(k, tree)`` over the numbers k below ``count``.

    Args:
        term: function of a number and a tree like ``tree``. It may launch kernels, and must read no attached array but those of
            the tree and ``implicit``.
        count: number of terms.
        tree: inputs of all terms. Attached.
        implicit: attached arrays that terms reach through Mitsuba's objects.

    Returns:
        (sums of the summed arrays; the own arrays of each term). Attached to tree and ``implicit``, in both modes.

    Source: "gradient checkpointing", Chen et al., "Training Deep Nets with Sublinear Memory Cost", 2016.
    """
    places, arrays = attached_places(tree)
    if not arrays and not implicit:
        return _evaluated(term, count, tree)
    call = _Call(term, count, list(implicit), tree_map(tree, dr.detach), places)
    sums, own = dr.custom(_Checkpointed, arrays, call.implicit, call)
    return sums, own


class _Call:
    """Arguments of a sum other than its arrays. No PyTree: Dr.Jit would pass ``implicit`` on without its gradients.

    ``places``: of the attached arrays in the tree.
    """

    def __init__(
        self, term: Callable[[int, PyTree], Term], count: int, implicit: list[AnyArray], tree: PyTree, places: tuple[int, ...]
    ) -> None:
        self.term, self.count, self.implicit, self.tree, self.places = term, count, implicit, tree, places

    def leaves(self) -> list[AnyArray]:
        """Attached copies of the tree's attached arrays."""
        return attached_copies(self.tree, self.places)

    def at(self, number: int, leaves: list[AnyArray]) -> Term:
        """A term, with these arrays as the attached ones of the tree."""
        return self.term(number, with_places(self.tree, self.places, leaves))


class _Checkpointed(dr.CustomOp):
    def eval(self, arrays: list[AnyArray], implicit: list[AnyArray], call: _Call) -> Any:  # Any: nested lists of arrays
        self._call = call
        self.add_input(implicit)
        # Dr.Jit detaches only what it is given: graphs from implicit arrays would keep all terms in memory.
        with dr.suspend_grad():
            return _evaluated(call.term, call.count, call.tree)

    def forward(self) -> None:
        call, totals, own = self._call, None, []
        tangents: Any = self.grad_in("arrays")  # Any: Dr.Jit's stub says object
        dr.eval(tangents)
        for k in range(call.count):
            with dr.resume_grad():
                leaves = call.leaves()
                for leaf, tangent in zip(leaves, tangents, strict=True):
                    dr.set_grad(leaf, tangent)
                summed, alone = call.at(k, leaves)
                # Only edges are cleared: other terms have yet to read the gradients of the implicit arrays.
                dr.forward_to(summed, alone, flags=dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad)
            totals, changes = _added(totals, dr.grad(summed)), dr.grad(alone)
            dr.eval(totals, changes)
            own.append(changes)
        self.set_grad_out((totals, own))

    def backward(self) -> None:
        call, gradients, implicit = self._call, None, None
        of_outputs: Any = self.grad_out()  # Any: Dr.Jit's stub says object
        of_sums, of_own = of_outputs
        dr.eval(of_sums, of_own)
        for k in range(call.count):
            with dr.resume_grad():
                leaves = call.leaves()
                summed, alone = call.at(k, leaves)
                outputs = [*summed, *alone]
                for output, gradient in zip(outputs, [*of_sums, *of_own[k]], strict=True):
                    if dr.grad_enabled(output):
                        dr.accum_grad(output, gradient)
                        dr.enqueue(dr.ADMode.Backward, output)
                # The graph stays: Mitsuba's objects may hold parts of it between their parameters and the arrays they look up.
                dr.traverse(dr.ADMode.Backward, flags=dr.ADFlag.ClearVertices)
            gradients = _added(gradients, [dr.grad(leaf) for leaf in leaves])
            implicit = _added(implicit, [dr.grad(array) for array in call.implicit])
            dr.eval(gradients, implicit)
            dr.clear_grad(call.implicit)
            del leaves, summed, alone, outputs
        for array, total in zip(call.implicit, implicit or [], strict=True):
            dr.accum_grad(array, total)
        self.set_grad_in("arrays", gradients)

    def name(self) -> str:
        return "checkpointed sum"


def _evaluated(term: Callable[[int, PyTree], Term], count: int, tree: PyTree) -> tuple[list[AnyArray], list[list[AnyArray]]]:
    totals, own = None, []
    for k in range(count):
        summed, alone = term(k, tree)
        totals = _added(totals, summed)
        dr.eval(totals, alone)
        own.append(alone)
    return totals or [], own


def _added(totals: list[AnyArray] | None, terms: list[AnyArray]) -> list[AnyArray]:
    return terms if totals is None else [total + term for total, term in zip(totals, terms, strict=True)]

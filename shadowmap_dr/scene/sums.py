"""Terms that Mitsuba evaluates for many lanes, one or a sum of terms per lane, differentiable in both modes.

Mitsuba's materials and lights look up their own parameters, so the derivatives of all lanes are summed into one number, or into
the texels of one texture. In single precision such a sum is accurate for at most some hundred thousand similar terms. So backward
passes to such parameters go over slices of the lanes, and the sum of each slice is moved out before the next slice begins.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi

from ..jit.broadcast import LIKE_LANES
from ..jit.pytree import attached_arrays, attached_copies, attached_of, attached_places, tree_map, with_places
from ..jit.types import AnyArray, Bool, PyTree, UInt32
from .mitsuba_objects import parameters

_ArrayT = TypeVar("_ArrayT", bound="AnyArray")

# Up to this many lanes Dr.Jit's own sums are accurate enough for single terms.
_FEW = 1 << 15
# Up to ``_EXPANDED`` numbers, sums in memory of each thread are faster than atomic additions. There ``_ONE_BY_ONE`` lanes with
# one term each lose less than 1e-5, whether they share one texel or many.
_EXPANDED, _ONE_BY_ONE = 1 << 16, 1 << 20


def attached_parameters(nodes: Sequence[mi.Object]) -> list[AnyArray]:
    """Parameters of Mitsuba's objects, their children included, through which gradients flow."""
    found = []
    for node in dict.fromkeys(nodes):
        found += [v for v in parameters(node).values() if dr.is_array_v(v) and dr.is_float_v(v) and dr.grad_enabled(v)]
    return found


def evaluate(term: Callable[[PyTree], _ArrayT], own: PyTree, nodes: Sequence[mi.Object], lanes: int) -> _ArrayT:
    """``term(own)``, which calls objects of Mitsuba's (``nodes``). Attached to the arrays of ``own`` and the nodes' parameters.

    ``own`` is a tree of arrays of width ``lanes`` or 1. ``term`` must read no other wide array.
    """
    implicit = attached_parameters(nodes) if lanes > _FEW else []
    if not implicit:
        return term(own)
    return _Sum.of(lambda _, own, __: term(own), None, None, own, (), implicit, lanes, True)


def sum_over(
    term: Callable[[UInt32, PyTree, PyTree], _ArrayT],
    count: int,
    zero: _ArrayT,
    own: PyTree,
    shared: PyTree,
    implicit: Sequence[AnyArray] = (),
    active: Bool | bool = True,
) -> _ArrayT:
    """Sum of ``term(index, own, shared)`` over the indices (UInt32) below ``count``.

    Args:
        term: returns an array of the type and width of ``zero``. It must read no wide array other than those of ``own`` and
            ``shared``. Derivatives evaluate it once more instead of keeping its graph.
        count: number of terms.
        zero: the start of the sum.
        own: tree of arrays as wide as ``zero``, or of width 1: each lane uses its own numbers.
        shared: tree of arrays that ``term`` gathers from.
        implicit: arrays that ``term`` reaches through Mitsuba's objects.
        active: Bool. Other lanes keep ``zero``; they cost nothing if all their neighbours are inactive, too.

    Returns:
        The sum, attached to both trees and to ``implicit``.
    """
    active = dr.detach(mi.Bool(active))
    if not attached_arrays((own, shared)) and not implicit:
        return _loop(lambda index: term(index, own, shared), count, zero, active)
    return _Sum.of(term, count, zero, own, shared, list(implicit), dr.width(zero), active)


def _loop(
    term: Callable[[UInt32], _ArrayT], count: int | None, zero: _ArrayT | None, active: Bool | bool, label: str = "soft light"
) -> _ArrayT:
    if count is None or zero is None:
        return term(mi.UInt32(0))

    def more(index: UInt32, total: _ArrayT) -> Bool:
        return active & (index < count)

    def add(index: UInt32, total: _ArrayT) -> tuple[UInt32, _ArrayT]:
        return index + 1, total + term(index)

    start = (dr.zeros(mi.UInt32, dr.width(zero)), type(zero)(zero))
    return dr.while_loop(start, more, add, mode="symbolic", label=label)[1]


class _Call:
    """Arguments of a sum other than its trees. No PyTree: Dr.Jit would pass ``implicit`` on without its gradients."""

    def __init__(
        self,
        term: Callable[[UInt32, PyTree, PyTree], AnyArray],
        count: int | None,
        zero: AnyArray | None,
        active: Bool | bool,
        implicit: list[AnyArray],
    ) -> None:
        self.term, self.count, self.zero, self.active, self.implicit = term, count, zero, active, implicit


class _Sum(dr.CustomOp):
    """The loop, or (``count`` None) the term alone, with derivatives of its own.

    Dr.Jit 1.5 fails in forward mode if several loops read the same array, and in backward mode if terms call Mitsuba's BSDFs.
    """

    @classmethod
    def of(
        cls,
        term: Callable[[UInt32, PyTree, PyTree], _ArrayT],
        count: int | None,
        zero: _ArrayT | None,
        own: PyTree,
        shared: PyTree,
        implicit: list[AnyArray],
        lanes: int,
        active: Bool | bool,
    ) -> _ArrayT:
        trees = (own, shared)
        places, arrays = attached_places(trees)
        detached = tree_map(trees, dr.detach)
        call = _Call(term, count, zero, active, implicit)
        return dr.custom(cls, arrays, implicit, (detached, places), len(attached_arrays(own)), call, lanes)

    def eval(
        self,
        arrays: list[AnyArray],
        implicit: list[AnyArray],
        trees: tuple[PyTree, tuple[int, ...]],
        owned: int,
        call: _Call,
        lanes: int,
    ) -> Any:  # Any: an array of the type of the terms
        self._trees, self._owned, self._call, self._lanes = trees, owned, call, lanes
        self.add_input(implicit)
        own, shared = trees[0]
        with dr.suspend_grad():  # Dr.Jit detaches only what it is given, not implicit arrays
            found = _loop(lambda index: call.term(index, own, shared), call.count, call.zero, call.active)
        self._shared_value = dr.width(found) == 1
        return found

    def forward(self) -> None:
        call, (tree, places) = self._call, self._trees
        leaves = attached_copies(tree, places)
        own, shared = with_places(tree, places, leaves)
        tangents: Any = self.grad_in("arrays")  # Any: Dr.Jit's stub says object
        dr.eval(tangents)
        for leaf, tangent in zip(leaves, tangents, strict=True):
            dr.set_grad(leaf, tangent)

        def change(index: UInt32) -> AnyArray:
            with dr.resume_grad():
                value = call.term(index, own, shared)
                # Only edges are cleared: other terms have yet to read the gradients of what parameters depend on. A term need
                # not depend on the attached numbers of the objects that it calls.
                flags = dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad
                dr.forward_to(value, flags=flags)
            return dr.grad(value)

        self.set_grad_out(_loop(change, call.count, call.zero, call.active, "soft light, forward"))

    def backward(self) -> None:
        call, tree = self._call, self._trees[0]
        gradient: Any = self.grad_out()  # Any: Dr.Jit's stub says object
        one_by_one = call.count is None and sum(_size(array) for array in call.implicit) <= _EXPANDED
        sliced = call.implicit or len(self._trees[1]) > self._owned
        size = self._lanes if not sliced else _ONE_BY_ONE if one_by_one else LIKE_LANES
        with _local_sums(bool(call.implicit) and not one_by_one):
            # A value that all lanes share, such as the radiance of a constant sky, has one gradient: the sum over the lanes.
            if size >= self._lanes or self._shared_value:
                self.set_grad_in("arrays", self._backward(tree, call.zero, gradient, call.active, self._lanes))
                dr.eval([dr.grad(array) for array in call.implicit])
                return
            dr.eval(tree[0], gradient, call.active)
            found, implicit = [], [_taken(call.implicit)]
            for first in range(0, self._lanes, size):
                width = min(size, self._lanes - first)
                # In memory, and not a constant: slices share their kernels.
                lane = dr.arange(mi.UInt32, width) + dr.opaque(mi.UInt32, first)
                own, zero, slopes, active = self._sliced((tree[0], call.zero, gradient, call.active), lane)
                found.append(self._backward((own, tree[1]), zero, slopes, active, width))
                implicit.append(_taken(call.implicit))
                dr.eval(found[-1], implicit[-1])
        for array, parts in zip(call.implicit, zip(*implicit, strict=True), strict=True):
            dr.accum_grad(array, _total(parts))
        own, shared = ([part[places] for part in found] for places in (slice(self._owned), slice(self._owned, None)))
        gradients = [self._joined(parts) for parts in zip(*own, strict=True)]
        self.set_grad_in("arrays", gradients + [_total(parts) for parts in zip(*shared, strict=True)])

    def _backward(
        self, tree: PyTree, zero: AnyArray | None, gradient: AnyArray, active: Bool | bool, width: int
    ) -> list[AnyArray]:
        """Gradients of all attached arrays. Those of ``own`` have as many numbers as there are lanes, or 1: their sum."""
        term, count, places = self._call.term, self._call.count, self._trees[1]
        leaves = [type(array)(array) for array in attached_of(tree, places)]
        shared = leaves[self._owned :]
        dr.enable_grad(shared)
        # Each lane sums its gradients of these from term to term; the shared arrays receive theirs from the adjoints of gathers.
        own = leaves[: self._owned]
        wide = [dr.repeat(leaf, width // dr.width(leaf)) for leaf in own]
        if count is not None:
            dr.eval(wide, gradient)

        def slopes(index: UInt32) -> list[AnyArray]:
            with dr.resume_grad():
                mine = [type(array)(array) for array in wide]
                dr.enable_grad(mine)
                value = term(index, *with_places(tree, places, mine + shared)) * gradient
                # The graph stays: Mitsuba's objects may hold parts of it between their parameters and the arrays they look up.
                dr.set_grad(value, 1)
                dr.enqueue(dr.ADMode.Backward, value)
                dr.traverse(dr.ADMode.Backward, flags=dr.ADFlag.ClearVertices)
            return [dr.grad(array) for array in mine]

        if count is None:
            sums = slopes(mi.UInt32(0))
        else:

            def more(index: UInt32, sums: list[AnyArray]) -> Bool:
                return active & (index < count)

            def add(index: UInt32, sums: list[AnyArray]) -> tuple[UInt32, list[AnyArray]]:
                return index + 1, [total + part for total, part in zip(sums, slopes(index), strict=True)]

            start = (dr.zeros(mi.UInt32, width), [dr.zeros(type(array), width) for array in wide])
            _, sums = dr.while_loop(start, more, add, mode="symbolic", label="soft light, backward")
        gathered = [dr.grad(leaf) for leaf in shared]
        # The lanes' sums and the gathers' adjoints in one kernel: otherwise the loop would run once for each.
        dr.eval(sums, gathered)
        return [dr.block_sum(total, width // dr.width(leaf)) for total, leaf in zip(sums, own, strict=True)] + gathered

    def _sliced(self, tree: PyTree, lane: UInt32) -> PyTree:
        def part(array: AnyArray) -> AnyArray:
            return dr.gather(type(array), array, lane) if dr.width(array) == self._lanes else array

        return tree_map(tree, part)

    def _joined(self, parts: Sequence[AnyArray]) -> AnyArray:
        """Gradient of one array of ``own`` from those of the slices."""
        first = parts[0]
        if sum(dr.width(part) for part in parts) != self._lanes:
            return _total(parts)  # the lanes share a number
        if dr.depth_v(first) == 1:
            return dr.concat(list(parts))
        return type(first)(*(self._joined([part[k] for part in parts]) for k in range(len(first))))

    def name(self) -> str:
        return "sum of terms"


def _total(parts: Sequence[AnyArray]) -> AnyArray:
    return sum(parts[1:], parts[0])


def _size(array: AnyArray) -> int:
    return dr.width(array) * (1 if dr.depth_v(array) <= 1 or dr.is_tensor_v(array) else dr.size_v(type(array)))


def _taken(arrays: Sequence[AnyArray]) -> list[AnyArray]:
    """The gradients of arrays, which are cleared."""
    found = [dr.grad(array) for array in arrays]
    dr.eval(found)
    dr.clear_grad(list(arrays))
    return found


_LOCK = threading.RLock()
_THRESHOLDS: list[int] = []


@contextmanager
def _local_sums(wanted: bool = True) -> Iterator[None]:
    """Context in which Dr.Jit sums the terms of neighbouring lanes before it adds them to their common target.

    By default it adds terms to arrays of up to a million numbers one by one, in memory of each thread.
    """
    if not wanted:
        yield
        return
    with _LOCK:
        _THRESHOLDS.append(dr.expand_threshold())
        dr.set_expand_threshold(0)
    try:
        yield
    finally:
        with _LOCK:
            least = _THRESHOLDS.pop()
            dr.set_expand_threshold(least)

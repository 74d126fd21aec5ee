"""Terms that Mitsuba works out for many lanes, one for each or a sum of them, differentiable in both modes.

Mitsuba's materials and lights look their parameters up by themselves, so that the derivatives of all lanes meet in one number,
or in the texels of one texture. In single precision such a sum may be of some hundred thousand like terms at most. So backward
passes to such parameters go over slices of the lanes, and what a slice has added up is taken away before the next one begins.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi

from ..jit.broadcast import LIKE_LANES
from ..jit.pytree import attached_arrays, attached_places, tree_map, with_places
from .mitsuba_objects import parameters

# Up to so many lanes Dr.Jit's own sums are exact enough for single terms.
_FEW = 1 << 15
# Threads that sum up in memory of their own are quicker than atomic additions, if there are at most so many numbers. So many
# lanes with a term each lose less than 1e-5 there, whether they share one texel or many.
_EXPANDED, _ONE_BY_ONE = 1 << 16, 1 << 20


def attached_parameters(nodes: Sequence[Any]) -> list[Any]:
    """Parameters of Mitsuba's objects, their children included, through which gradients flow."""
    found = []
    for node in dict.fromkeys(nodes):
        found += [v for v in parameters(node).values() if dr.is_array_v(v) and dr.is_float_v(v) and dr.grad_enabled(v)]
    return found


def evaluate(term: Callable[[Any], Any], own: Any, nodes: Sequence[Any], lanes: int) -> Any:
    """``term(own)``, which calls objects of Mitsuba's (``nodes``). Attached to the arrays of ``own`` and the nodes' parameters.

    ``own`` is a tree of arrays as long as there are ``lanes``, or of width 1. ``term`` may look at no other wide array.
    """
    implicit = attached_parameters(nodes) if lanes > _FEW else []
    if not implicit:
        return term(own)
    return _Sum.of(lambda _, own, __: term(own), None, None, own, (), implicit, lanes, True)


def sum_over(
    term: Callable[[Any, Any, Any], Any],
    count: int,
    zero: Any,
    own: Any,
    shared: Any,
    implicit: Sequence[Any] = (),
    active: Any = True,
) -> Any:
    """Sum of ``term(index, own, shared)`` (of the type and width of ``zero``) over the indices (UInt32) below ``count``.

    ``own`` and ``shared`` are trees of arrays: each lane uses its own numbers of the arrays of the first, which are as wide as
    ``zero`` or of width 1, and gathers from those of the second. ``term`` may look at no other wide array. It is worked out once
    more for derivatives, instead of being kept. Gradients flow to both trees and to ``implicit``, arrays that ``term`` reaches
    through Mitsuba's objects. Lanes that are not ``active`` (Bool) keep ``zero``, and cost nothing where all their neighbours are
    not, either.
    """
    active = dr.detach(mi.Bool(active))
    if not attached_arrays((own, shared)) and not implicit:
        return _loop(lambda index: term(index, own, shared), count, zero, active)
    return _Sum.of(term, count, zero, own, shared, list(implicit), dr.width(zero), active)


def _loop(term: Callable[[Any], Any], count: int | None, zero: Any, active: Any, label: str = "soft light") -> Any:
    if count is None:
        return term(mi.UInt32(0))
    _, total = dr.while_loop(
        (dr.zeros(mi.UInt32, dr.width(zero)), type(zero)(zero)),
        lambda index, total: active & (index < count),
        lambda index, total: (index + 1, total + term(index)),
        mode="symbolic",
        label=label,
    )
    return total


class _Call:
    """Parts of a sum, besides arrays of its own. No PyTree: Dr.Jit would hand over ``implicit`` without its gradients."""

    def __init__(self, term: Any, count: int | None, zero: Any, active: Any, implicit: list[Any]) -> None:
        self.term, self.count, self.zero, self.active, self.implicit = term, count, zero, active, implicit


class _Sum(dr.CustomOp):
    """The loop, or (``count`` None) the term alone, with derivatives of its own.

    Dr.Jit 1.5 fails in forward mode where a loop reads what others read too, and backwards where terms call BSDFs of Mitsuba's.
    """

    @classmethod
    def of(
        cls, term: Any, count: int | None, zero: Any, own: Any, shared: Any, implicit: list[Any], lanes: int, active: Any
    ) -> Any:
        trees = (own, shared)
        places, arrays = attached_places(trees)
        detached = tree_map(trees, dr.detach)
        call = _Call(term, count, zero, active, implicit)
        return dr.custom(cls, arrays, implicit, (detached, places), len(attached_arrays(own)), call, lanes)

    def eval(
        self, arrays: list[Any], implicit: list[Any], trees: tuple[Any, tuple[int, ...]], owned: int, call: _Call, lanes: int
    ) -> Any:
        self._trees, self._owned, self._call, self._lanes = trees, owned, call, lanes
        self.add_input(implicit)
        own, shared = trees[0]
        found = _loop(lambda index: call.term(index, own, shared), call.count, call.zero, call.active)
        self._shared_value = dr.width(found) == 1
        return found

    def forward(self) -> None:
        call, (tree, places) = self._call, self._trees
        leaves = [type(array)(array) for array in attached_of(tree, places)]
        dr.enable_grad(leaves)
        own, shared = with_places(tree, places, leaves)
        tangents = self.grad_in("arrays")
        dr.eval(tangents)
        for leaf, tangent in zip(leaves, tangents, strict=True):
            dr.set_grad(leaf, tangent)

        def change(index: Any) -> Any:
            with dr.resume_grad():
                value = call.term(index, own, shared)
                # What parameters hang on keeps its gradients, which other terms have yet to read. Terms may call objects that
                # hold attached numbers and depend on none of them.
                flags = dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad
                dr.forward_to(value, flags=flags)
            return dr.grad(value)

        self.set_grad_out(_loop(change, call.count, call.zero, call.active, "soft light, forward"))

    def backward(self) -> None:
        call, tree, gradient = self._call, self._trees[0], self.grad_out()
        one_by_one = call.count is None and sum(_size(array) for array in call.implicit) <= _EXPANDED
        sliced = call.implicit or len(self._trees[1]) > self._owned
        size = self._lanes if not sliced else _ONE_BY_ONE if one_by_one else LIKE_LANES
        with _local_sums(bool(call.implicit) and not one_by_one):
            # A value that all lanes share, such as the radiance of a constant sky, has one gradient, which is their sum already.
            if size >= self._lanes or self._shared_value:
                self.set_grad_in("arrays", self._backward(tree, call.zero, gradient, call.active, self._lanes))
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

    def _backward(self, tree: Any, zero: Any, gradient: Any, active: Any, width: int) -> list[Any]:
        """Gradients of all attached arrays, those of its own as long as there are lanes or summed up if their width is 1."""
        term, count, places = self._call.term, self._call.count, self._trees[1]
        leaves = [type(array)(array) for array in attached_of(tree, places)]
        shared = leaves[self._owned :]
        dr.enable_grad(shared)
        # A lane's part of these is added up from term to term; the others receive theirs where the terms gather from them.
        own = leaves[: self._owned]
        wide = [dr.repeat(leaf, width // dr.width(leaf)) for leaf in own]
        if count is not None:
            dr.eval(wide, gradient)

        def slopes(index: Any) -> list[Any]:
            with dr.resume_grad():
                mine = [type(array)(array) for array in wide]
                dr.enable_grad(mine)
                value = term(index, *with_places(tree, places, mine + shared)) * gradient
                # The graph stays: Mitsuba's objects may hold parts of it between their parameters and what they look up.
                dr.set_grad(value, 1)
                dr.enqueue(dr.ADMode.Backward, value)
                dr.traverse(dr.ADMode.Backward, flags=dr.ADFlag.ClearVertices)
            return [dr.grad(array) for array in mine]

        if count is None:
            sums = slopes(mi.UInt32(0))
        else:
            _, sums = dr.while_loop(
                (dr.zeros(mi.UInt32, width), [dr.zeros(type(array), width) for array in wide]),
                lambda index, sums: active & (index < count),
                lambda index, sums: (index + 1, [total + part for total, part in zip(sums, slopes(index), strict=True)]),
                mode="symbolic",
                label="soft light, backward",
            )
        gathered = [dr.grad(leaf) for leaf in shared]
        # What lanes add up, and what they send elsewhere, in one pass of the loop: it would run once for each.
        dr.eval(sums, gathered)
        return [dr.block_sum(total, width // dr.width(leaf)) for total, leaf in zip(sums, own, strict=True)] + gathered

    def _sliced(self, tree: Any, lane: Any) -> Any:
        def part(array: Any) -> Any:
            return dr.gather(type(array), array, lane) if dr.width(array) == self._lanes else array

        return tree_map(tree, part)

    def _joined(self, parts: Sequence[Any]) -> Any:
        """Results of slices for one array of the lanes' own."""
        first = parts[0]
        if sum(dr.width(part) for part in parts) != self._lanes:
            return _total(parts)  # the lanes share a number
        if dr.depth_v(first) == 1:
            return dr.concat(list(parts))
        return type(first)(*(self._joined([part[k] for part in parts]) for k in range(len(first))))

    def name(self) -> str:
        return "sum of terms"


def attached_of(tree: Any, places: tuple[int, ...]) -> list[Any]:
    """The arrays at some places of a tree, counted as :func:`~shadowmap_dr.jit.pytree.tree_map` comes to them."""
    found: list[Any] = []

    def collect(array: Any) -> Any:
        found.append(array)
        return array

    tree_map(tree, collect)
    return [found[place] for place in places]


def _total(parts: Sequence[Any]) -> Any:
    return sum(parts[1:], parts[0])


def _size(array: Any) -> int:
    return dr.width(array) * (1 if dr.depth_v(array) <= 1 or dr.is_tensor_v(array) else dr.size_v(type(array)))


def _taken(arrays: Sequence[Any]) -> list[Any]:
    """The gradients of arrays, which hold none any more."""
    found = [dr.grad(array) for array in arrays]
    dr.eval(found)
    dr.clear_grad(list(arrays))
    return found


_LOCK = threading.RLock()
_THRESHOLDS: list[int] = []


@contextmanager
def _local_sums(wanted: bool = True) -> Iterator[None]:
    """Within, Dr.Jit adds up the terms of neighbouring lanes before it adds them to what they have in common.

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

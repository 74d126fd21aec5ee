"""Results of one computation for a second one that begins in the same way, such as an image and its derivatives.

The first computation runs in :func:`keeping`, the second one in :func:`using`. Functions of this module mark the results that are
worth it: arrays that are evaluated in any case.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar, cast

import drjit as dr

from .arrays import backend, interleave, replace_grad
from .kernel_inputs import uint_input
from .pytree import tree_map
from .types import Float, PyTree

ResultT = TypeVar("ResultT")
TreeT = TypeVar("TreeT", bound=PyTree)

#: Names of results, and the detached results, in the order of the first computation.
Results = list[tuple[str, PyTree]]


class _State(threading.local):
    """``kept``: results of the computation that runs, if any are kept; ``given``: those of the first, if there were any."""

    kept: Results | None = None
    given: Iterator[tuple[str, PyTree]] | None = None


_state = _State()


@contextmanager
def keeping() -> Iterator[Results]:
    """Keep the results of the computation inside."""
    before, _state.kept = _state.kept, []
    try:
        yield _state.kept
    finally:
        _state.kept = before


@contextmanager
def using(results: Results) -> Iterator[None]:
    """Use the results of an earlier computation, of the same steps with the same numbers, inside; if any, else compute them.

    Raises:
        RuntimeError: the steps are not the same.
    """
    before, _state.given = _state.given, iter(results) if results else None
    try:
        yield
    finally:
        _state.given = before


def computed(name: str, function: Callable[[], ResultT]) -> ResultT:
    """Result of a function that returns detached arrays, or the result of the first computation."""
    if _state.given is not None:
        return _next(name)
    result = function()
    if _state.kept is not None:
        _state.kept.append((name, result))
    return result


def evaluated(name: str, tree: TreeT) -> TreeT:
    """Evaluate the arrays of a tree, or take their values from the first computation. Derivatives are those of the tree."""
    if _state.given is not None:
        values = iter(_arrays(_next(name)))
        return tree_map(tree, lambda array: replace_grad(next(values), array))
    dr.eval(tree)
    if _state.kept is not None:
        _state.kept.append((name, tree_map(tree, dr.detach)))
    return tree


def interleaved(name: str, values: list[Float]) -> Float:
    """Flat array with the entries of several arrays interleaved, :func:`evaluated`."""
    if len(values) == 1:
        return evaluated(name, values[0])
    if _state.given is None:
        return evaluated(name, interleave(values))
    given = _next(name)
    return dr.custom(_Interleaved, given, values) if dr.grad_enabled(values) else given


def apart(flat: Float, count: int, entries: int | None = None, first: int = 0) -> list[Float]:
    """The ``count`` arrays whose entries ``interleave`` has put into a flat one. Attached.

    Args:
        flat: the array.
        count: numbers of each entry.
        entries: number of entries that are read; None for all of them.
        first: the first of these. No entry may be read twice, as its adjoint is written, not added.
    """
    module = backend(flat)
    size = next(size for size in (4, 2, 1) if count % size == 0)
    packet = {1: module.Float, 2: module.Array2f, 4: module.Array4f}[size]
    entry = dr.arange(module.UInt32, dr.width(flat) // count if entries is None else entries)
    if first:
        entry += uint_input(module, "first entry", first)
    mode = dr.ReduceMode.NoConflicts
    found = [dr.gather(packet, flat, entry * (count // size) + k, mode=mode) for k in range(count // size)]
    return found if size == 1 else [value for values in found for value in values]


class _Interleaved(dr.CustomOp):
    """Known interleaved values, with the derivatives of the values. Writing these once more would be a kernel of its own."""

    def eval(self, given: Float, values: list[Float]) -> Float:
        self.count = len(values)
        return given

    def backward(self) -> None:
        adjoint = cast("Float", self.grad_out())
        module = backend(adjoint)
        packet = {2: module.Array2f, 4: module.Array4f}.get(self.count)
        lane = dr.arange(module.UInt32, dr.width(adjoint) // self.count)
        if packet is None:
            parts = [dr.gather(module.Float, adjoint, lane * self.count + k) for k in range(self.count)]
        else:
            parts = list(dr.gather(packet, adjoint, lane))
        self.set_grad_in("values", parts)


def _next(name: str) -> PyTree:
    assert _state.given is not None
    known, result = next(_state.given, ("nothing", None))
    if known != name:
        raise RuntimeError(f"the second computation needs {name} where the first one has {known}")
    return result


def _arrays(tree: PyTree) -> list[PyTree]:
    found: list[PyTree] = []

    def collect(array: PyTree) -> PyTree:
        found.append(array)
        return array

    tree_map(tree, collect)
    return found

"""Results of one computation for a second one that begins in the same way, such as an image and its derivatives.

The first computation runs in :func:`keeping`, the second one in :func:`using`. Functions of this module mark the results that are
worth it: arrays that are evaluated in any case.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import TypeVar, cast

import drjit as dr

from .arrays import interleave, replace_grad
from .frozen import take_apart
from .kernel_inputs import SharingOp
from .packets import apart, packed
from .pytree import ArrayTuple, arrays_of, tree_map
from .types import AnyArray, Float, PyTree

ResultT = TypeVar("ResultT")
TreeT = TypeVar("TreeT", bound=PyTree)

# Lanes, the most, of trees that are stored for derivatives: 48 MiB for a colour.
_MOST_STORED = 1 << 22

#: Names of results, and the detached results, in the order of the first computation.
Results = list[tuple[str, PyTree]]


class _Layout:
    """Results without their arrays. (No record: recordings do not walk through it.)"""

    def __init__(self, results: Results) -> None:
        self.results = tree_map(results, lambda array: type(array)())
        self._text = take_apart(results)[0]

    def recording_text(self) -> str:
        """Everything but the arrays, as it was when the results were packed."""
        return self._text


@dataclass(frozen=True)
class PackedResults:
    """Results as one tuple of arrays: to walk through their records for each recording would take longer than to pass them on."""

    layout: _Layout
    arrays: ArrayTuple

    @classmethod
    def of(cls, results: Results) -> PackedResults:
        """Pack results."""
        arrays: list[AnyArray] = []

        def collect(array: AnyArray) -> AnyArray:
            arrays.append(array)
            return array

        tree_map(results, collect)
        return cls(_Layout(results), ArrayTuple(arrays))

    def unpacked(self) -> Results:
        """The results."""
        given = iter(self.arrays)
        found: Results = tree_map(self.layout.results, lambda array: next(given))
        return found

    def __bool__(self) -> bool:
        return bool(self.arrays)


#: Of a computation that has kept none.
NO_RESULTS = PackedResults.of([])


class _State(threading.local):
    """State of the computation that runs.

    kept    its results, if any are kept
    given   those of the first, if there were any
    valued  False if only derivatives are asked for
    """

    kept: Results | None = None
    given: Iterator[tuple[str, PyTree]] | None = None
    valued: bool = True


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


@contextmanager
def derivatives_only() -> Iterator[None]:
    """Leave the values of the computation inside undefined where they cost time: only its derivatives are asked for."""
    before, _state.valued = _state.valued, False
    try:
        yield
    finally:
        _state.valued = before


def wants_values() -> bool:
    """False within :func:`derivatives_only`."""
    return _state.valued


def second_computation(results: PackedResults) -> AbstractContextManager[None]:
    """Context of a second computation that is asked for derivatives: :func:`using` the results of the first, if there are any."""
    return using(results.unpacked()) if results else derivatives_only()


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
        values = iter(arrays_of(_next(name)))
        return tree_map(tree, lambda array: replace_grad(next(values), array))
    dr.eval(tree)
    if _state.kept is not None:
        _state.kept.append((name, tree_map(tree, dr.detach)))
    return tree


def stored(name: str, tree: TreeT, beside: PyTree = None) -> TreeT:
    """Write the arrays of a tree to memory with what is evaluated next, so that derivatives need not compute them again.

    Derivatives need them if the tree is attached, or arrays that it is multiplied with (``beside``). Values may be those of the
    first computation. Derivatives are those of the tree. Trees of more than four million lanes are left alone.
    """
    if not _state.valued or max((dr.width(array) for array in arrays_of(tree)), default=0) > _MOST_STORED:
        return tree
    if _state.given is not None:
        return evaluated(name, tree)
    if _state.kept is not None:
        _state.kept.append((name, tree_map(tree, dr.detach)))
    if _state.kept is not None or dr.grad_enabled(tree, beside):
        dr.schedule(tree)
    return tree


def interleaved(name: str, values: list[Float], parts: int = 1) -> Float:
    """Flat array with the entries of several arrays interleaved, :func:`evaluated`.

    ``parts``: number of equal parts of ``values`` that come after one another; of several, each is a multiple of four arrays.
    """
    if len(values) == 1:
        return evaluated(name, values[0])
    in_packets = parts > 1 or (len(values) > 4 and len(values) % 4 == 0)
    if _state.given is None:
        return evaluated(name, packed(values, parts) if in_packets else interleave(values))
    given = _next(name)
    return dr.custom(_Interleaved, given, values, parts) if dr.grad_enabled(values) else given


class _Interleaved(SharingOp):
    """Known interleaved values, with the derivatives of the values. Writing these once more would be a kernel of its own."""

    def eval(self, given: Float, values: list[Float], parts: int) -> Float:
        self.count, self.parts = len(values), parts
        return given

    def backward(self) -> None:
        found = apart(cast("Float", self.grad_out()), self.count // self.parts, self.parts)
        self.set_grad_in("values", [value for part in found for value in part])


def _next(name: str) -> PyTree:
    assert _state.given is not None
    known, result = next(_state.given, ("nothing", None))
    if known != name:
        raise RuntimeError(f"the second computation needs {name} where the first one has {known}")
    return result

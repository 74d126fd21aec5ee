"""Results of one computation for a second one that begins in the same way, such as an image and its derivatives.

The first computation runs in :func:`keeping`, the second one in :func:`using`. Functions of this module mark the results that are
worth it: arrays that are evaluated in any case.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar, cast

import drjit as dr

from .arrays import backend, interleave, replace_grad
from .kernel_inputs import uint_input
from .pytree import tree_map
from .types import AnyArray, Float, PyTree, UInt32

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


def interleaved(name: str, values: list[Float], parts: int = 1) -> Float:
    """Flat array with the entries of several arrays interleaved, :func:`evaluated`.

    ``parts``: number of equal parts of ``values`` that come after one another; of several, each is a multiple of four arrays.
    """
    if len(values) == 1:
        return evaluated(name, values[0])
    packed = parts > 1 or (len(values) > 4 and len(values) % 4 == 0)
    if _state.given is None:
        return evaluated(name, dr.custom(_Packed, values, parts) if packed else interleave(values))
    given = _next(name)
    return dr.custom(_Interleaved, given, values, parts) if dr.grad_enabled(values) else given


def apart(flat: Float, count: int, parts: int = 1) -> list[list[Float]]:
    """The arrays whose entries ``interleave`` has put into a flat one. Attached.

    Args:
        flat: ``parts`` arrays of ``count`` interleaved numbers for each entry, one after the other.

    Returns:
        For each part the ``count`` arrays.
    """
    found: list[Float] = dr.custom(_Apart, flat, count, parts)
    return [found[k * count : (k + 1) * count] for k in range(parts)]


class _Apart(dr.CustomOp):
    """:func:`apart`. Dr.Jit's own adjoint of these gathers would add to zeros, number by number."""

    def eval(self, flat: Float, count: int, parts: int) -> list[Float]:
        self.module, self.count, self.parts, self.width = backend(flat), count, parts, dr.width(flat)
        self.size = next(size for size in (4, 2, 1) if count % size == 0)
        return self._apart(flat)

    def forward(self) -> None:
        self.set_grad_out(self._apart(cast("Float", self.grad_in("flat"))))

    def backward(self) -> None:
        adjoints, result = cast("list[Float]", self.grad_out()), dr.empty(self.module.Float, self.width)
        for k, packet in enumerate(self._packets()):
            values = adjoints[k * self.size : (k + 1) * self.size]
            dr.scatter(result, values[0] if self.size == 1 else self._kind(*values), packet)
        self.set_grad_in("flat", result)

    def name(self) -> str:
        return "apart"

    @property
    def _kind(self) -> type[AnyArray]:
        return {1: self.module.Float, 2: self.module.Array2f, 4: self.module.Array4f}[self.size]

    def _packets(self) -> Iterator[UInt32]:
        """Indices of packets of ``size`` numbers: for each part the first packet of all entries, then the second, ..."""
        entries, each = self.width // (self.count * self.parts), self.count // self.size
        entry = dr.arange(self.module.UInt32, entries)
        for part in range(self.parts):
            first = entry + uint_input(self.module, "first entry", part * entries) if part else entry
            for k in range(each):
                yield first * each + k

    def _apart(self, flat: Float) -> list[Float]:
        found: list[Any] = [dr.gather(self._kind, flat, packet) for packet in self._packets()]  # Any: packets of any size
        return found if self.size == 1 else [value for values in found for value in values]


class _Packed(dr.CustomOp):
    """Interleaved values, written in packets of four: a kernel for each number would read all of them again."""

    def eval(self, values: list[Float], parts: int) -> Float:
        self.count, self.parts = len(values) // parts, parts
        return self._written(values)

    def forward(self) -> None:
        self.set_grad_out(self._written(cast("list[Float]", self.grad_in("values"))))

    def backward(self) -> None:
        found = apart(cast("Float", self.grad_out()), self.count, self.parts)
        self.set_grad_in("values", [value for part in found for value in part])

    def name(self) -> str:
        return "packed"

    def _written(self, values: list[Float]) -> Float:
        module, entries = backend(values[0]), max(dr.width(value) for value in values)
        entry, each = dr.arange(module.UInt32, entries), self.count // 4
        result = dr.empty(module.Float, len(values) * entries)
        for k in range(len(values) // 4):
            part, number = divmod(k, each)
            place = entry + uint_input(module, "first entry", part * entries) if part else entry
            dr.scatter(result, module.Array4f(*values[4 * k : 4 * k + 4]), place * each + number)
        return result


class _Interleaved(dr.CustomOp):
    """Known interleaved values, with the derivatives of the values. Writing these once more would be a kernel of its own."""

    def eval(self, given: Float, values: list[Float], parts: int) -> Float:
        self.count, self.parts = len(values), parts
        return given

    def backward(self) -> None:
        adjoint = cast("Float", self.grad_out())
        if self.parts > 1:
            self.set_grad_in("values", [value for part in apart(adjoint, self.count // self.parts, self.parts) for value in part])
            return
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

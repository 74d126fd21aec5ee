"""The crossing between PyTorch's autograd and Dr.Jit's.

Dr.Jit's own ``drjit.wrap`` shares memory with both sides and has no graph left after a backward pass: an optimiser that moves its
parameters between the two passes, or a second backward pass, gets wrong gradients without a word. Here nothing is shared, and
each backward pass makes a graph of its own.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import ModuleType
from typing import Any, Protocol

import drjit as dr
import torch

from ..jit.arrays import backend
from .checks import backend_of

# Held by the thread in which Dr.Jit works.
_TURN = threading.RLock()


class Operation(Protocol):
    """Something that Dr.Jit computes from float tensors, and its derivatives. An object is good for one call."""

    def forward(self, arrays: list[Any], wanted: list[bool]) -> Sequence[Any]:
        """Results (Dr.Jit tensors) for Dr.Jit tensors. ``wanted`` tells which of these need gradients; maybe none."""

    def backward(self, adjoints: Sequence[Any]) -> Sequence[Any]:
        """Gradients to the arrays (of those that are not wanted: anything) from those to the results (None: zero)."""


class Repeated:
    """A differentiable Dr.Jit function, which is evaluated once more for its derivatives.

    No graph is kept in between: one that is dropped, or that is to serve for another backward pass, Dr.Jit 1.5 never frees.
    """

    def __init__(self, function: Callable[..., Sequence[Any]]) -> None:
        self.function = function

    def forward(self, arrays: list[Any], wanted: list[bool]) -> Sequence[Any]:
        self.arrays, self.wanted = arrays, wanted
        with dr.suspend_grad():
            return self.function(*arrays)

    def backward(self, adjoints: Sequence[Any]) -> Sequence[Any]:
        with dr.resume_grad():
            arrays = attached(self.arrays, self.wanted)
            return gradients(arrays, self.function(*arrays), adjoints)


def attached(arrays: Sequence[Any], wanted: Sequence[bool]) -> list[Any]:
    """The same arrays, with gradients where they are wanted."""
    copies = [type(array)(array) for array in arrays]
    dr.enable_grad([copy for copy, want in zip(copies, wanted, strict=True) if want])
    return copies


def gradients(arrays: Sequence[Any], results: Sequence[Any], adjoints: Sequence[Any]) -> list[Any]:
    """Gradients of the sum of <result, adjoint> to attached arrays. Ends the graph."""
    starts = [r for r, a in zip(results, adjoints, strict=True) if a is not None and dr.grad_enabled(r)]
    for result, adjoint in zip(results, adjoints, strict=True):
        if adjoint is not None and dr.grad_enabled(result):
            dr.accum_grad(result, adjoint)
    dr.enqueue(dr.ADMode.Backward, starts)
    # Not the results' gradients: a result may be an array that was passed through.
    dr.traverse(dr.ADMode.Backward, dr.ADFlag.ClearInterior | dr.ADFlag.ClearEdges)
    found = [dr.grad(array) for array in arrays]
    dr.eval(found)
    return found


def cross(operation: Operation, *tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Results of an operation on (checked) float32 tensors of one device, at least one, as part of PyTorch's graph."""
    return _Crossing.apply(operation, torch.is_grad_enabled(), *tensors)


def to_drjit(tensor: torch.Tensor) -> Any:
    """A Dr.Jit tensor with memory of its own, float32 or int32."""
    # Copied by PyTorch, and shared with the copy: that nobody else knows.
    copy = tensor.detach().clone(memory_format=torch.contiguous_format)
    module = backend_of(tensor.device)
    return (module.TensorXf if tensor.dtype == torch.float32 else module.TensorXi)(copy)


def index_array(indices: torch.Tensor) -> Any:
    """(Checked) indices as a flat ``UInt32`` array."""
    with drjit_turn(indices.device) as module:
        array = to_drjit(indices.to(torch.int32)).array
        result = module.UInt32(array)
        dr.eval(result)
    return result


def number(flat: Any, index: Any) -> Any:
    """Numbers of a small array, none of them twice."""
    return _gathered(backend(flat).Float, flat, index)


def vector(flat: Any, index: Any) -> Any:
    """Vectors (``Array3f``) of a small array of interleaved ones, none of them twice."""
    return _gathered(backend(flat).Array3f, flat, index)


def _gathered(kind: Any, flat: Any, index: Any) -> Any:
    # Said to have no conflicts: the adjoints that Dr.Jit 1.5 chooses by itself for small arrays lose the first of several numbers
    # whose gradients are sums of the same kind themselves.
    return dr.gather(kind, flat, backend(flat).UInt32(index), mode=dr.ReduceMode.NoConflicts)


def to_torch(array: Any) -> torch.Tensor:
    """A PyTorch tensor with the values of a Dr.Jit tensor, in memory of its own. Only where it is the thread's turn: it waits."""
    return dr.detach(array).torch().clone()


@contextmanager
def drjit_turn(device: torch.device) -> Iterator[ModuleType]:
    """Let Dr.Jit work: on what PyTorch has finished, and finishing before PyTorch goes on. Yields the module of its types.

    Whatever may wait for Dr.Jit belongs inside, reading an array back included. Threads help Dr.Jit while they wait, and sums
    lose terms where two of them do (Dr.Jit 1.5, ``docs/dr-jit-faults/shared_sums.py``).

    Also keeps alive what is made inside until it is no longer read: arrays that share memory with PyTorch must not be dropped
    before the end of this context.
    """
    module = backend_of(device)
    if device.type == "cuda":
        torch.cuda.current_stream(device).synchronize()
    # Dr.Jit orders what it traces by scopes, which count up across threads. So one thread at a time, each in scopes of its own:
    # PyTorch may call from another one than before.
    with _TURN:
        dr.detail.new_scope(dr.backend_v(module.Float))
        try:
            yield module
        finally:
            dr.sync_thread()
            dr.detail.new_scope(dr.backend_v(module.Float))


class _Crossing(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, operation: Operation, record: bool, *tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        wanted = [record and needed for needed in ctx.needs_input_grad[2:]]
        with drjit_turn(tensors[0].device):
            arrays = [to_drjit(tensor) for tensor in tensors]
            results = operation.forward(arrays, wanted)
            dr.eval(results)
            found = tuple(to_torch(result) for result in results)
        ctx.operation, ctx.wanted, ctx.device = operation, wanted, tensors[0].device
        ctx.set_materialize_grads(False)
        return found

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *adjoints: torch.Tensor | None) -> tuple[torch.Tensor | None, ...]:
        with drjit_turn(ctx.device):
            arrays = [None if adjoint is None else to_drjit(adjoint) for adjoint in adjoints]
            found = ctx.operation.backward(arrays)
            dr.eval(found)
            wanted = zip(found, ctx.wanted, strict=True)
            given = [to_torch(gradient) if want else None for gradient, want in wanted]
        return None, None, *given

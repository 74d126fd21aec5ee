"""Arrays and derivatives between PyTorch and Dr.Jit. :mod:`.crossing` makes them a part of PyTorch's graph.

Dr.Jit's own ``drjit.wrap`` shares memory with both sides, and a backward pass frees its graph: an optimiser that changes
parameters between the two passes, or a second backward pass, silently gets wrong gradients. Here no memory is shared, and each
backward pass builds its own graph.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import ModuleType
from typing import Any, cast

import drjit as dr
import torch

from ..jit.arrays import backend
from ..jit.types import AnyArray, ArrayT, Bool, Float, TensorXf, UInt32, Vector3f
from .checks import backend_of
from .transforms import outside

#: Takes the place of an array in a record whose values a PyTorch tensor holds.
IN_TENSOR: Any = None  # Any: arrays of several types

# Bytes at a multiple of which an array begins that Dr.Jit's kernels may read where it lies, see `jit.arrays`.
_ALIGNED = 64
# Numbers of arrays that are copied by kernels.
_LARGE = 1 << 16
# Held by the thread in which Dr.Jit works.
_TURN = threading.RLock()


def attached(arrays: Sequence[ArrayT], wanted: Sequence[bool]) -> list[ArrayT]:
    """Copies of arrays, with gradients where they are wanted."""
    copies = [_copy(array) for array in arrays]
    dr.enable_grad([copy for copy, want in zip(copies, wanted, strict=True) if want])
    return copies


def gradients(arrays: Sequence[ArrayT], results: Sequence[TensorXf], adjoints: Sequence[TensorXf | None]) -> list[ArrayT]:
    """Gradients of the sum of <result, adjoint> to attached arrays. Frees the graph."""
    starts = [r for r, a in zip(results, adjoints, strict=True) if a is not None and dr.grad_enabled(r)]
    for result, adjoint in zip(results, adjoints, strict=True):
        if adjoint is not None and dr.grad_enabled(result):
            dr.accum_grad(result, adjoint)
    dr.enqueue(dr.ADMode.Backward, starts)
    # Gradients of the graph's ends stay: a result may be one of the arrays itself.
    dr.traverse(dr.ADMode.Backward, dr.ADFlag.ClearInterior | dr.ADFlag.ClearEdges)
    found = [dr.grad(array) for array in arrays]
    dr.eval(found)
    return found


def to_drjit(tensor: torch.Tensor) -> Any:  # Any: TensorXf or TensorXi, as the tensor's type
    """A Dr.Jit tensor with memory of its own, float32 or int32. ``tensor``: not batched by ``torch.vmap``."""
    # The memory of PyTorch's copy is shared: nobody else has this copy.
    return outside(lambda numbers: borrowed(numbers.clone(memory_format=torch.contiguous_format)), tensor)


def borrowed(tensor: torch.Tensor) -> Any:  # Any: TensorXf or TensorXi, as the tensor's type
    """A Dr.Jit tensor in the memory of a contiguous tensor, float32 or int32, whose numbers nobody will change."""
    module, plain = backend_of(tensor.device), tensor.detach()
    if plain.data_ptr() % _ALIGNED:
        plain = plain.clone(memory_format=torch.contiguous_format)
    return (module.TensorXf if tensor.dtype == torch.float32 else module.TensorXi)(plain)


def copy_of(tensor: torch.Tensor) -> Any:  # Any: TensorXf or TensorXi, as the tensor's type
    """As :func:`to_drjit`, in a function that PyTorch calls outside of all transforms, and in :func:`drjit_turn`."""
    if _is_large(tensor.numel()) and tensor.device.type == "cpu":
        return copied(borrowed(tensor.contiguous()))
    return borrowed(tensor.clone(memory_format=torch.contiguous_format))


def index_array(indices: torch.Tensor) -> UInt32:
    """(Checked, plain) indices as a flat ``UInt32`` array."""
    with drjit_turn(indices.device) as module:
        array = to_drjit(indices.to(torch.int32)).array
        result = module.UInt32(array)
        dr.eval(result)
    return result


def mask_array(mask: torch.Tensor) -> Bool:
    """A (checked, plain) boolean tensor as a flat ``Bool`` array."""
    with drjit_turn(mask.device):
        result = index_array(mask) != 0
        dr.eval(result)
    return result


def number(flat: Float, index: UInt32 | int) -> Float:
    """Numbers of a small array. ``index``: no number twice."""
    return _gathered(backend(flat).Float, flat, index)


def vector(flat: Float, index: UInt32 | int) -> Vector3f:
    """Vectors (``Array3f``) of a small array of interleaved components. ``index``: no vector twice."""
    return _gathered(backend(flat).Array3f, flat, index)


def _gathered(kind: type[ArrayT], flat: Float, index: UInt32 | int) -> ArrayT:
    # ``NoConflicts``, since the adjoint that Dr.Jit 1.5 chooses for small arrays loses the first of several numbers if their
    # incoming gradients are sums of the same kind.
    return dr.gather(kind, flat, backend(flat).UInt32(index), mode=dr.ReduceMode.NoConflicts)


def to_torch(array: AnyArray) -> torch.Tensor:
    """A PyTorch tensor with the values of a Dr.Jit tensor, in memory of its own. Call it in :func:`drjit_turn`: it waits."""
    own = dr.detach(array)
    if _is_large(dr.width(own.array)) and dr.backend_v(own) == dr.JitBackend.LLVM:
        return cast(torch.Tensor, copied(own).torch())
    return cast(torch.Tensor, own.torch()).clone()


def copied(array: AnyArray) -> AnyArray:
    """An evaluated copy of a (detached) Dr.Jit tensor, in memory of its own."""
    flat = array.array
    # By a kernel: Dr.Jit hands out memory that it has used before. The system would map new memory page by page.
    lane = dr.arange(backend(flat).UInt32, dr.width(flat))
    copy: AnyArray = type(array)(dr.gather(type(flat), flat, lane), array.shape)
    dr.eval(copy)
    return copy


def _is_large(count: int) -> bool:
    """True if the C library maps new memory for as many numbers, instead of using its own."""
    return count >= _LARGE


def forward_derivatives(
    arrays: Sequence[ArrayT], results: Sequence[TensorXf], tangents: Sequence[TensorXf | None]
) -> list[TensorXf]:
    """Derivatives of results along the tangents (None for zero) of attached arrays. Frees the graph."""
    for array, tangent in zip(arrays, tangents, strict=True):
        if tangent is not None:
            dr.set_grad(array, tangent)
    dr.enqueue(dr.ADMode.Forward, [array for array, tangent in zip(arrays, tangents, strict=True) if tangent is not None])
    dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearInterior | dr.ADFlag.ClearEdges)
    found = [dr.grad(result) for result in results]
    dr.eval(found)
    return found


def _copy(array: ArrayT) -> ArrayT:
    copy: Callable[[ArrayT], ArrayT] = type(array)
    return copy(array)


@contextmanager
def drjit_turn(device: torch.device) -> Iterator[ModuleType]:
    """Context in which one thread uses Dr.Jit, synchronised with PyTorch at both ends. Yields the module of Dr.Jit's types.

    All calls that may wait for Dr.Jit belong inside, including reading an array back. Waiting threads help Dr.Jit, and sums lose
    terms if two threads do so at once (Dr.Jit 1.5, ``docs/dr-jit-faults/shared_sums.py``).

    The end of the context waits for all kernels: arrays that share memory with PyTorch must live until then.
    """
    module = backend_of(device)
    if device.type == "cuda":
        torch.cuda.current_stream(device).synchronize()
    # Dr.Jit orders traced operations by scopes, which it numbers across threads. PyTorch may call from several threads, so one
    # thread works at a time, in scopes of its own.
    with _TURN:
        dr.detail.new_scope(dr.backend_v(module.Float))
        try:
            yield module
        finally:
            dr.sync_thread()
            dr.detail.new_scope(dr.backend_v(module.Float))

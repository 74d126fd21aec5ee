"""Dr.Jit's functions as part of PyTorch's graph: ``backward``, ``torch.func`` (``grad``, ``jvp``, ``vmap``), ``torch.compile``.

Each function has first derivatives, forward and in reverse. Second derivatives raise an error instead of being zero in silence:
derivatives are themselves nodes of the graph (:class:`_First`) that depend on all inputs.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NoReturn, ParamSpec, Protocol, TypeAlias, TypeVar

import drjit as dr
import torch

from ..errors import ShadowmapError
from ..jit.types import TensorXf
from .bridge import attached, borrowed, copy_of, drjit_turn, forward_derivatives, gradients, to_torch

_P = ParamSpec("_P")
_R = TypeVar("_R")
_Batched: TypeAlias = tuple[tuple[torch.Tensor, ...], tuple[int, ...]]


class Operation(Protocol):
    """A differentiable function of float tensors that Dr.Jit evaluates. An object serves one call.

    Attributes:
        name: public name of the function, for messages.
        unbatched: what to do instead of ``torch.vmap``; empty if that works.
    """

    name: str
    unbatched: str

    def forward(self, arrays: list[TensorXf]) -> Sequence[TensorXf]:
        """Results (Dr.Jit tensors) for Dr.Jit tensors."""

    def backward(self, arrays: list[TensorXf], wanted: Sequence[bool], adjoints: Sequence[TensorXf | None]) -> Sequence[TensorXf]:
        """Gradients to the arrays, arbitrary for arrays that need none. ``adjoints``: gradients to the results, None for zero."""

    def jvp(self, arrays: list[TensorXf], tangents: Sequence[TensorXf | None]) -> Sequence[TensorXf]:
        """Derivatives of the results along tangents of the arrays, None for zero."""

    def again(self) -> Operation:
        """The same function, for another call."""


class Repeated:
    """A differentiable Dr.Jit function, which is evaluated once more for its derivatives.

    No graph is kept in between: Dr.Jit 1.5 never frees a graph that is dropped or that must serve several backward passes.
    """

    def __init__(self, name: str, function: Callable[..., Sequence[TensorXf]], unbatched: str = "") -> None:
        self.name, self.function, self.unbatched = name, function, unbatched

    def forward(self, arrays: list[TensorXf]) -> Sequence[TensorXf]:
        with dr.suspend_grad():
            return self.function(*arrays)

    def backward(self, arrays: list[TensorXf], wanted: Sequence[bool], adjoints: Sequence[TensorXf | None]) -> Sequence[TensorXf]:
        with dr.resume_grad():
            arrays = attached(arrays, wanted)
            return gradients(arrays, self.function(*arrays), adjoints)

    def jvp(self, arrays: list[TensorXf], tangents: Sequence[TensorXf | None]) -> Sequence[TensorXf]:
        with dr.resume_grad():
            arrays = attached(arrays, [tangent is not None for tangent in tangents])
            return forward_derivatives(arrays, self.function(*arrays), tangents)

    def again(self) -> Repeated:
        return self


def cross(operation: Operation, *tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Results of an operation as part of PyTorch's graph. ``tensors``: at least one; checked, float32, on one device."""
    # The graph keeps copies: the caller may change tensors in place before the backward pass.
    copies = [tensor.clone(memory_format=torch.contiguous_format) for tensor in tensors]
    return _Crossing.apply(_Call(operation), *copies)


def eager(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorator: code compiled by ``torch.compile`` calls the function as it is. (Dr.Jit compiles it itself.)"""

    disable: Any = torch.compiler.disable  # Any: its stub has no types
    disabled: list[Callable[_P, _R]] = []

    @functools.wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        # Unless this module is there, nothing is being compiled; to import it takes seconds.
        if "torch._dynamo" not in sys.modules:
            return function(*args, **kwargs)
        if not disabled:
            disabled.append(disable(function))
        return disabled[0](*args, **kwargs)

    return call


@dataclass
class _Call:
    """One call of an operation. Where ``torch.vmap`` has batched it, ``parts`` are the calls for each of the batch."""

    operation: Operation
    parts: list[_Call] = field(default_factory=list)


@dataclass
class _Derivative:
    """A call to be differentiated: ``count`` adjoints or tangents come before its inputs.

    ``wanted``: the inputs for gradients; None for forward mode.
    """

    call: _Call
    count: int
    wanted: Sequence[bool] | None = None

    def at(self, k: int) -> _Derivative:
        """That for one of the batch."""
        return _Derivative(self.call.parts[k], self.count, self.wanted)

    def evaluate(self, given: list[TensorXf | None], inputs: list[TensorXf]) -> list[TensorXf]:
        """Gradients to the wanted inputs from adjoints, or derivatives of the results along tangents."""
        operation = self.call.operation
        if self.wanted is None:
            return list(operation.jvp(inputs, given))
        found = operation.backward(inputs, self.wanted, given)
        return [gradient for gradient, want in zip(found, self.wanted, strict=True) if want]


class _Node(torch.autograd.Function):
    """A function of (something, tensors...), some of them None, with what all of them have in common."""

    @classmethod
    def looped(cls, things: Sequence[object], size: int, in_dims: tuple[Any, ...], tensors: tuple[Any, ...]) -> _Batched:
        """The function for each of a batch, stacked. Any: sizes and tensors, or None."""
        found = []
        for thing, k in zip(things, range(size), strict=True):
            own = [t if d is None else t.select(d, k).contiguous() for t, d in zip(tensors, in_dims, strict=True)]
            found.append(cls.apply(thing, *own))
        results = tuple(torch.stack(each) for each in zip(*found, strict=True))
        return results, (0,) * len(results)


class _Crossing(_Node):
    @staticmethod
    def forward(call: _Call, *tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        with drjit_turn(tensors[0].device):
            results = call.operation.forward([borrowed(tensor.contiguous()) for tensor in tensors])
            dr.eval(results)
            return tuple(to_torch(result) for result in results)

    @staticmethod
    def setup_context(
        ctx: Any,  # Any: PyTorch's stubs lack the attributes of a context
        inputs: tuple[Any, ...],
        output: tuple[torch.Tensor, ...],
    ) -> None:
        ctx.call, *tensors = inputs
        ctx.save_for_backward(*tensors)
        ctx.save_for_forward(*tensors)
        ctx.set_materialize_grads(False)

    @staticmethod
    def backward(
        ctx: Any,  # Any: PyTorch's stubs lack the attributes of a context
        *adjoints: torch.Tensor | None,
    ) -> tuple[torch.Tensor | None, ...]:
        wanted = ctx.needs_input_grad[1:]
        if all(adjoint is None for adjoint in adjoints):
            return None, *(None for _ in wanted)
        given = iter(_First.apply(_Derivative(ctx.call, len(adjoints), wanted), *adjoints, *ctx.saved_tensors))
        return None, *(next(given) if want else None for want in wanted)

    @staticmethod
    def jvp(
        ctx: Any,  # Any: PyTorch's stubs lack the attributes of a context
        *tangents: torch.Tensor | None,
    ) -> tuple[torch.Tensor, ...]:
        return _First.apply(_Derivative(ctx.call, len(tangents) - 1), *tangents[1:], *ctx.saved_tensors)

    @staticmethod
    def vmap(
        info: Any,  # Any: a type that PyTorch does not show
        in_dims: tuple[Any, ...],
        call: _Call,
        *tensors: torch.Tensor,
    ) -> _Batched:
        operation = call.operation
        if operation.unbatched:
            raise ShadowmapError(f"{operation.name}: torch.vmap cannot batch it; {operation.unbatched}.")
        call.parts = [_Call(operation.again()) for _ in range(info.batch_size)]
        return _Crossing.looped(call.parts, info.batch_size, in_dims[1:], tensors)


class _First(_Node):
    """A first derivative, which has none itself."""

    @staticmethod
    def forward(given: _Derivative, *tensors: torch.Tensor | None) -> tuple[torch.Tensor, ...]:
        with _arrays(given, tensors) as arrays:
            found = given.evaluate(*arrays)
            dr.eval(found)
            return tuple(to_torch(derivative) for derivative in found)

    @staticmethod
    def setup_context(
        ctx: Any,  # Any: PyTorch's stubs lack the attributes of a context
        inputs: tuple[Any, ...],
        output: tuple[torch.Tensor, ...],
    ) -> None:
        ctx.name = inputs[0].call.operation.name

    @staticmethod
    def backward(
        ctx: Any,  # Any: PyTorch's stubs lack the attributes of a context
        *_: torch.Tensor,
    ) -> NoReturn:
        raise _second(ctx.name)

    @staticmethod
    def jvp(
        ctx: Any,  # Any: PyTorch's stubs lack the attributes of a context
        *_: torch.Tensor,
    ) -> NoReturn:
        raise _second(ctx.name)

    @staticmethod
    def vmap(
        info: Any,  # Any: a type that PyTorch does not show
        in_dims: tuple[Any, ...],
        given: _Derivative,
        *tensors: torch.Tensor | None,
    ) -> _Batched:
        # If only adjoints or tangents are batched, there was one call.
        several = any(dim is not None for dim in in_dims[1 + given.count :])
        calls = [given.at(k) if several else given for k in range(info.batch_size)]
        return _First.looped(calls, info.batch_size, in_dims[1:], tensors)


@contextmanager
def _arrays(given: _Derivative, tensors: tuple[torch.Tensor | None, ...]) -> Iterator[tuple[list[Any], list[Any]]]:
    """Context in which Dr.Jit works, with its arrays for adjoints (tangents) and for inputs."""
    device = next(tensor.device for tensor in tensors if tensor is not None)
    with drjit_turn(device):
        # Copies: their memory belongs to PyTorch, and kernels may write into the arrays.
        first = [None if tensor is None else copy_of(tensor) for tensor in tensors[: given.count]]
        yield first, [borrowed(tensor.contiguous()) for tensor in tensors[given.count :] if tensor is not None]


def _second(name: str) -> ShadowmapError:
    return ShadowmapError(
        f"{name}: it has first derivatives only; take differences of gradients instead of differentiating it twice."
    )

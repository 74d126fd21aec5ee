"""Numbers of tensors outside of the transforms of ``torch.func``, in which each operation wraps its result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, NoReturn, TypeVar, cast

import torch

from ..errors import ShadowmapError

_R = TypeVar("_R")


def outside(function: Callable[[torch.Tensor], _R], tensor: torch.Tensor, what: str = "a tensor", instead: str = "") -> _R:
    """``function`` of the numbers of a tensor, detached, called outside of all transforms.

    Args:
        what, instead: for the message if ``torch.vmap`` has batched the tensor: its name, and what to do.
    """
    call = _Call(function, what, instead or "give one that is the same for all of the batch")
    with torch.no_grad():
        _Outside.apply(call, tensor)
    return cast(_R, call.result)


def plain(what: str, tensor: torch.Tensor, instead: str) -> torch.Tensor:
    """The numbers of a tensor, detached. Operations on it inside of a transform wrap their results again.

    Raises:
        ShadowmapError: ``torch.vmap`` has batched the tensor. ``what`` names it, ``instead`` says what to do.
    """
    return outside(lambda numbers: numbers, tensor, what, instead)


@dataclass
class _Call(Generic[_R]):
    function: Callable[[torch.Tensor], _R]
    what: str
    instead: str
    result: _R | None = None


class _Outside(torch.autograd.Function):
    """Calls a function where PyTorch calls ``forward``: outside of all transforms."""

    @staticmethod
    def forward(call: _Call[Any], tensor: torch.Tensor) -> torch.Tensor:
        call.result = call.function(tensor.detach())
        return tensor.new_empty(0)

    @staticmethod
    def setup_context(
        ctx: Any,  # Any: PyTorch's stubs lack the attributes of a context
        inputs: tuple[Any, ...],
        output: torch.Tensor,
    ) -> None:
        ctx.mark_non_differentiable(output)

    @staticmethod
    def jvp(
        ctx: Any,  # Any: PyTorch's stubs lack the attributes of a context
        *_: torch.Tensor | None,
    ) -> None:
        return None

    @staticmethod
    def vmap(
        info: Any,  # Any: a type that PyTorch does not show
        in_dims: tuple[Any, ...],
        call: _Call[Any],
        tensor: torch.Tensor,
    ) -> NoReturn:
        raise ShadowmapError(f"{call.what}: torch.vmap cannot batch it; {call.instead}.")

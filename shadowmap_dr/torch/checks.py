"""Checks of tensors. Every error message is one line that names the tensor and tells how to fix it."""

from __future__ import annotations

from numbers import Integral, Real
from types import ModuleType
from typing import Any, TypeVar

import drjit as dr
import torch

from ..errors import ShadowmapError

_NumberT = TypeVar("_NumberT", int, float)

_INTEGERS = (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64)


def backend_of(device: torch.device) -> ModuleType:
    """The Dr.Jit module (``drjit.llvm.ad`` or ``drjit.cuda.ad``) that computes with tensors of a device."""
    return dr.llvm.ad if device.type == "cpu" else dr.cuda.ad


def check_floats(name: str, tensor: torch.Tensor, *shapes: tuple[int | str, ...]) -> None:
    """Raise ShadowmapError unless ``tensor`` is a strided float32 tensor of one of the shapes.

    Shapes are tuples of sizes; a name stands for any positive size, "..." at the start for any leading sizes.
    """
    _check_tensor(name, tensor)
    if tensor.dtype != torch.float32:
        raise ShadowmapError(f"{name}: {tensor.dtype}, but must be torch.float32; convert with .float().")
    if not any(_fits(tensor.shape, shape) for shape in shapes):
        raise ShadowmapError(f"{name}: shape {tuple(tensor.shape)}, but must be {' or '.join(map(_written, shapes))}.")
    if tensor.numel() == 0:
        raise ShadowmapError(f"{name}: shape {tuple(tensor.shape)} holds no numbers.")


def check_indices(name: str, tensor: torch.Tensor, count: int, what: str = "vertices") -> None:
    """Raise ShadowmapError unless ``tensor`` is integer (F, 3), F > 0, with indices from 0 to ``count - 1``. Reads them all."""
    check_face_shape(name, tensor)
    low, high = (int(value) for value in torch.aminmax(tensor))
    if low < 0 or high >= count:
        raise ShadowmapError(f"{name}: indices from {low} to {high}, but there are {count} {what}, counted from 0.")


def check_face_shape(name: str, tensor: torch.Tensor, batched: bool = False) -> None:
    """Raise ShadowmapError unless ``tensor`` is integer (F, 3), or, if ``batched``, (B, F, 3), with B, F > 0."""
    _check_tensor(name, tensor)
    if tensor.dtype not in _INTEGERS:
        raise ShadowmapError(f"{name}: {tensor.dtype}, but must be integers; convert with .int().")
    if tensor.ndim not in ((2, 3) if batched else (2,)) or tensor.shape[-1] != 3 or tensor.numel() == 0:
        wanted = "(F, 3) or (B, F, 3)" if batched else "(F, 3)"
        raise ShadowmapError(f"{name}: shape {tuple(tensor.shape)}, but must be {wanted} with at least one triangle.")


def check_flags(name: str, tensor: torch.Tensor, shape: tuple[int, ...]) -> None:
    """Raise ShadowmapError unless ``tensor`` is boolean, of the shape."""
    _check_tensor(name, tensor)
    if tensor.dtype != torch.bool:
        raise ShadowmapError(f"{name}: {tensor.dtype}, but must be torch.bool; convert with .bool().")
    if tuple(tensor.shape) != shape:
        raise ShadowmapError(f"{name}: shape {tuple(tensor.shape)}, but must be {_written(shape)}.")


def check_devices(**tensors: torch.Tensor) -> torch.device:
    """The common device of (checked) tensors. Raises ShadowmapError, with the arguments' names, if they have several."""
    (first, tensor), *others = tensors.items()
    for name, other in others:
        if other.device != tensor.device:
            raise ShadowmapError(f"{name}: on {other.device}, but {first} on {tensor.device}; move them to one device.")
    return tensor.device


def check_kind(name: str, value: object, *kinds: type) -> None:
    """Raise ShadowmapError unless ``value`` is an instance of one of the types."""
    if not isinstance(value, kinds):
        wanted = " or ".join(kind.__name__ for kind in kinds)
        raise ShadowmapError(f"{name}: {type(value).__name__}, but must be {wanted}.")


def number_of(name: str, value: object, kind: type[_NumberT]) -> _NumberT:
    """A number, of Python or NumPy, as an int or a float. Raises ShadowmapError for other objects and for fractions as ints."""
    if not isinstance(value, Integral if kind is int else Real) or isinstance(value, bool):
        raise ShadowmapError(f"{name}: {type(value).__name__}, but must be {kind.__name__}.")
    number: Any = value  # Any: int() takes no Real in the stubs
    return kind(number)


def check_same(what: str, given: object, expected: object, hint: str) -> None:
    """Raise ShadowmapError unless two sizes are equal."""
    if given != expected:
        raise ShadowmapError(f"{what}: {given} instead of {expected}; {hint}.")


def _check_tensor(name: str, tensor: object) -> None:
    if not isinstance(tensor, torch.Tensor):
        raise ShadowmapError(f"{name}: {type(tensor).__name__}, but must be a torch.Tensor.")
    if tensor.layout != torch.strided:
        raise ShadowmapError(f"{name}: {tensor.layout}, but must be a dense tensor; convert with .to_dense().")
    kinds = {"cpu": dr.JitBackend.LLVM, "cuda": dr.JitBackend.CUDA}
    if tensor.device.type not in kinds:
        raise ShadowmapError(f"{name}: on {tensor.device}, but Dr.Jit computes on cpu and cuda only; move it with .cpu().")
    if not dr.has_backend(kinds[tensor.device.type]):
        other = "cuda" if tensor.device.type == "cpu" else "cpu"
        lacking = "no LLVM library" if tensor.device.type == "cpu" else "no GPU"
        raise ShadowmapError(f"{name}: on {tensor.device}, but Dr.Jit found {lacking}; move it with .to('{other}').")


def _fits(sizes: tuple[int, ...], shape: tuple[int | str, ...]) -> bool:
    if shape[:1] == ("...",):
        shape = shape[1:]
        sizes = sizes[max(0, len(sizes) - len(shape)) :]
    return len(sizes) == len(shape) and all(isinstance(s, str) or s == size for s, size in zip(shape, sizes, strict=True))


def _written(shape: tuple[int | str, ...]) -> str:
    return f"({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})"

"""Numbers that kernels read from memory, so that one kernel serves all of their values.

Dr.Jit writes a Python number into the code of a kernel: images of another size would need kernels of their own, each compiled for
a tenth of a second and more. Sizes of images, maps and meshes are therefore passed as inputs.
"""

from __future__ import annotations

import atexit
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from functools import lru_cache, wraps
from types import ModuleType
from typing import Any, ParamSpec, TypeVar, cast

import drjit as dr

from .arrays import backend
from .types import Float, Float64, Int32, UInt32

P = ParamSpec("P")
ResultT = TypeVar("ResultT")

# Inputs that are kept. An image has a few dozen.
_MOST = 4096


@lru_cache(maxsize=_MOST)
def _kept(kind: Any, name: str, value: float, scope: int) -> Any:  # Any: a type of arrays, an array
    return dr.opaque(kind, value)


atexit.register(_kept.cache_clear)  # before Dr.Jit looks for leaked arrays


Inputs = dict[tuple[Any, str, float], Any]


class _Current(threading.local):
    shared: Inputs | None = None


_current = _Current()


@contextmanager
def shared_inputs(inputs: Inputs | None = None) -> Generator[None]:
    """Let all code inside share equal inputs while a function is recorded; outside of recordings they are always shared.

    A recording refuses arrays that were made before it. Without this, it would make an array after each symbolic loop anew, and
    each replay would write hundreds of them.

    ``inputs``: those of code that ran before in the same recording, to be shared as well.
    """
    before = _current.shared
    if not dr.flag(dr.JitFlag.FreezingScope) or (inputs is None and before is not None):
        yield
        return
    _current.shared = {} if inputs is None else inputs
    try:
        yield
    finally:
        _current.shared = before


def with_current_inputs(function: Callable[P, ResultT]) -> Callable[P, ResultT]:
    """A function that shares the inputs of the code around, also where derivatives call it once more."""
    inputs = _current.shared
    if inputs is None:
        return function

    def sharing(*args: P.args, **kwargs: P.kwargs) -> ResultT:
        with shared_inputs(inputs):
            return function(*args, **kwargs)

    return sharing


class SharingOp(dr.CustomOp):
    """A differentiable operation whose derivatives share the inputs of the code around it."""

    def __init__(self) -> None:
        super().__init__()
        self._inputs = _current.shared

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        for name in ("forward", "backward"):
            if name in vars(cls):
                setattr(cls, name, _shared(vars(cls)[name]))


def _shared(method: Callable[[Any], None]) -> Callable[[Any], None]:
    @wraps(method)
    def run(op: SharingOp) -> None:
        with shared_inputs(op._inputs):
            method(op)

    return run


def _number(kind: Any, name: str, value: float) -> Any:  # Any: as above
    if not dr.flag(dr.JitFlag.FreezingScope):
        return _kept(kind, name, value, -1)
    if _current.shared is None:
        return _kept(kind, name, value, dr.detail.scope(dr.backend_v(kind)))
    key = (kind, name, value)
    if key not in _current.shared:
        _current.shared[key] = dr.opaque(kind, value)
    return _current.shared[key]


def float_input(module: ModuleType, name: str, value: float) -> Float:
    """``Float`` of width 1 that kernels read from memory. Detached, evaluated.

    Args:
        module: the Dr.Jit module of the type.
        name: of the quantity from which the number follows, such as "width". A kernel has one input for equal numbers of one
            name. Numbers of different names are different inputs, even if they are equal: otherwise images that are as high as
            wide would need kernels of their own again.
        value: the number.
    """
    number: Float = _number(module.Float, name, float(value))
    return number


def double_input(module: ModuleType, name: str, value: float) -> Float64:
    """As :func:`float_input`, in double precision."""
    number: Float64 = _number(module.Float64, name, float(value))
    return number


def uint_input(module: ModuleType, name: str, value: int) -> UInt32:
    """As :func:`float_input`, a whole number from 0 to 2^32 - 1."""
    number: UInt32 = _number(module.UInt32, name, int(value))
    return number


def int_input(module: ModuleType, name: str, value: int) -> Int32:
    """As :func:`float_input`, a signed whole number."""
    number: Int32 = _number(module.Int32, name, int(value))
    return number


def quotient(number: UInt32, name: str, divisor: int) -> UInt32:
    """``number // divisor`` for numbers below 2^31, with a divisor (and its name) that kernels read from memory.

    Processors divide integers slowly, one after the other. With ``2^(k - 1) < divisor <= 2^k`` the quotient is
    ``number * ceil(2^(31 + k) / divisor) >> 31 + k``, and that factor has 32 bits (Granlund and Montgomery, "Division by
    invariant integers using multiplication", 1994).
    """
    if not 1 <= divisor < 2**31:
        raise ValueError(f"divisor is {divisor}; give 1 to 2^31 - 1")
    if divisor == 1:
        return number
    module, bits = backend(number), (divisor - 1).bit_length()
    factor = -(-(1 << (31 + bits)) // divisor)
    high = dr.mul_hi(number, uint_input(module, f"factor for {name}", factor))
    return cast("UInt32", high) >> uint_input(module, f"shift for {name}", bits - 1)


def split(index: UInt32, name: str, size: int, count: int) -> tuple[UInt32, UInt32]:
    """(``index // size``, ``index % size``) of indices below ``count * size``, for ``size`` things of a name.

    For a count of 1 the first is a constant 0, and kernels hold no division.
    """
    if count == 1:
        return type(index)(0), index
    group = quotient(index, name, size)
    return group, index - group * uint_input(backend(index), name, size)

"""Arrays in Dr.Jit's own memory.

Dr.Jit borrows NumPy's and PyTorch's memory where it can. Its kernels for CPUs read whole vectors of numbers, up to 60 bytes
beyond an array's end, where foreign memory may end, too: the process is then lost. Arrays that begin at a multiple of 64 bytes,
such as those of PyTorch's own, are safe. And the address, with its alignment, becomes a part of the kernels that read a borrowed
array and of the inputs that frozen functions compare, so that there is a new kernel or recording now and then.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any, cast

import drjit as dr
import numpy as np
import numpy.typing as npt

from .types import AnyArray, ArrayT, Bool, Float, TensorXf, UInt32

_DTYPES = {dr.VarType.Float32: np.float32, dr.VarType.UInt32: np.uint32, dr.VarType.Bool: np.bool_}


def device_array(kind: type[ArrayT], values: npt.ArrayLike) -> ArrayT:
    """All numbers of ``values``, in C order, as an array of the flat Dr.Jit type ``kind`` (``Float``, ``UInt32`` or ``Bool``).

    NumPy converts the numbers. ``values`` may change afterwards. The array is evaluated.
    """
    host: npt.NDArray[Any] = np.ascontiguousarray(values, _DTYPES[dr.type_v(kind)]).ravel()
    if dr.backend_v(kind) == dr.JitBackend.LLVM:
        return _written(kind, host)
    array = cast(Callable[[npt.NDArray[Any]], ArrayT], kind)(host)
    dr.eval(array)
    dr.sync_thread()  # Dr.Jit may read it later
    return array


def device_tensor(kind: type[TensorXf], values: npt.ArrayLike) -> TensorXf:
    """As :func:`device_array`, a tensor with the shape of ``values``."""
    host = np.asarray(values, np.float32)
    return kind(device_array(dr.array_t(kind), host), host.shape)


def own_memory(array: ArrayT) -> ArrayT:
    """An evaluated copy of a flat array or tensor. Detached. Borrowed memory must not change before the next synchronization."""
    flat: Any = dr.detach(array)  # Any: arithmetic on an array of any type
    if not dr.width(flat):
        return flat
    if dr.backend_v(flat) == dr.JitBackend.LLVM and not dr.flag(dr.JitFlag.FreezingScope):
        return _written(type(array), np.asarray(flat))
    kind: Any = type(dr.ravel(flat)) if dr.is_tensor_v(flat) else type(flat)  # Any: `dr.ravel` returns object
    copy = flat | dr.opaque(kind, False) if dr.is_mask_v(flat) else flat + dr.opaque(kind, 0)
    dr.eval(copy)
    return copy


def _written(kind: type[ArrayT], host: npt.NDArray[Any]) -> ArrayT:
    """An array of Dr.Jit's, on a CPU, into which NumPy has written numbers."""
    array = dr.empty(kind, host.shape if dr.is_tensor_v(kind) else host.size)
    if host.size:
        np.asarray(array)[...] = host  # a view, for which Dr.Jit waits until the memory is free
    return array


# Dr.Jit's own functions, with the types that its stubs lack.


def ravel(array: AnyArray) -> Float:
    """``dr.ravel`` of floating-point arrays: components interleaved, C order. Attached."""
    return cast("Float", dr.ravel(array))


def interleave(values: list[Float]) -> Float:
    """Flat array with the entries of several arrays interleaved. Attached."""
    module = backend(values[0])
    if len(values) == 1:
        return values[0]
    packet = {2: module.Array2f, 4: module.Array4f}.get(len(values), module.ArrayXf)
    return ravel(packet(*values) if packet is not module.ArrayXf else packet(values))


def replace_grad(value: ArrayT, source: ArrayT) -> ArrayT:
    """``dr.replace_grad``: the numbers of ``value`` with the derivatives of ``source``."""
    return cast(Callable[[ArrayT, ArrayT], ArrayT], dr.replace_grad)(value, source)


def reinterpret(kind: type[ArrayT], array: AnyArray) -> ArrayT:
    """``dr.reinterpret_array``: the bits of an array as another type of the same size. Detached."""
    return cast(ArrayT, dr.reinterpret_array(cast("type[AnyArray]", kind), array))


def scatter_inc(target: UInt32, index: UInt32, active: Bool | bool = True) -> UInt32:
    """``dr.scatter_inc``: increment ``target[index]`` atomically; returns its values before."""
    return cast("UInt32", dr.scatter_inc(target, index, active))


def backend(array: AnyArray) -> ModuleType:
    """The Dr.Jit module (``drjit.llvm``, ``drjit.llvm.ad``, ``drjit.cuda.ad``, ...) of an array's types.

    Nested types of other libraries (such as ``mitsuba.Point3f``) are resolved through their components.
    """
    leaf = array
    while dr.depth_v(leaf) > 1 and not dr.is_tensor_v(leaf):
        leaf = leaf[0]
    return sys.modules[type(leaf).__module__]

"""Arrays in Dr.Jit's own memory.

Dr.Jit borrows NumPy's memory where it can. The address, and with it its alignment, then becomes a part of the kernels that read
the array and of the inputs that frozen functions compare. So a borrowed array causes a new kernel or recording now and then.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any, cast

import drjit as dr
import numpy as np
import numpy.typing as npt

from .types import AnyArray, ArrayT, Bool, Float, UInt32

# Waiting for Dr.Jit to read an array takes less time than a copy of this size.
_MANY_BYTES = 1 << 20

_DTYPES = {dr.VarType.Float32: np.float32, dr.VarType.UInt32: np.uint32, dr.VarType.Bool: np.bool_}


def device_array(kind: type[ArrayT], values: npt.ArrayLike) -> ArrayT:
    """All numbers of ``values``, in C order, as an array of the flat Dr.Jit type ``kind`` (``Float``, ``UInt32`` or ``Bool``).

    NumPy converts the numbers. ``values`` may change afterwards. The array is evaluated.
    """
    host: npt.NDArray[Any] = np.ascontiguousarray(values, _DTYPES[dr.type_v(kind)])
    make = cast(Callable[[npt.NDArray[Any]], ArrayT], kind)
    if host.nbytes < _MANY_BYTES:
        return own_memory(make(host.ravel().copy()))  # Dr.Jit may read it later
    array = own_memory(make(host.ravel()))
    dr.sync_thread()
    return array


def own_memory(array: ArrayT) -> ArrayT:
    """An evaluated copy of a flat array or tensor. Detached. Borrowed memory must not change before the next synchronization."""
    flat: Any = dr.detach(array)  # Any: arithmetic on an array of any type
    if not dr.width(flat):
        return flat
    kind: Any = type(dr.ravel(flat)) if dr.is_tensor_v(flat) else type(flat)  # Any: `dr.ravel` returns object
    copy = flat | dr.opaque(kind, False) if dr.is_mask_v(flat) else flat + dr.opaque(kind, 0)
    dr.eval(copy)
    return copy


# Dr.Jit's own functions, with the types that its stubs lack.


def ravel(array: AnyArray) -> Float:
    """``dr.ravel`` of floating-point arrays: components interleaved, C order. Attached."""
    return cast("Float", dr.ravel(array))


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

"""Arrays in memory of Dr.Jit's own.

Dr.Jit borrows NumPy's memory where it can. Where that lies, by chance, is a part of the kernels that read it and of what recorded
functions compare, so that borrowed arrays are compiled for and recorded once more now and then.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np
import numpy.typing as npt

# Waiting for Dr.Jit to read an array takes less time than a copy of this size.
_MANY_BYTES = 1 << 20

_DTYPES = {dr.VarType.Float32: np.float32, dr.VarType.UInt32: np.uint32, dr.VarType.Bool: np.bool_}


def device_array(kind: type, values: npt.ArrayLike) -> Any:
    """All numbers of ``values``, in C order, as an array of the flat Dr.Jit type ``kind`` (``Float``, ``UInt32`` or ``Bool``).

    Numbers are converted as NumPy does it. ``values`` may change afterwards. The array is evaluated.
    """
    host = np.ascontiguousarray(values, _DTYPES[dr.type_v(kind)])
    if host.nbytes < _MANY_BYTES:
        return own_memory(kind(host.ravel().copy()))  # Dr.Jit may come to read it only later
    array = own_memory(kind(host.ravel()))
    dr.sync_thread()
    return array


def own_memory(array: Any) -> Any:
    """An evaluated copy of a flat array or tensor. Detached. Borrowed memory must stay as it is until Dr.Jit is waited for."""
    array = dr.detach(array)
    if not dr.width(array):
        return array
    kind = type(dr.ravel(array)) if dr.is_tensor_v(array) else type(array)
    copy = array | dr.opaque(kind, False) if dr.is_mask_v(array) else array + dr.opaque(kind, 0)
    dr.eval(copy)
    return copy


def backend(array: Any) -> ModuleType:
    """The Dr.Jit module (``drjit.llvm``, ``drjit.llvm.ad``, ``drjit.cuda.ad``, ...) whose types ``array`` is made of.

    Nested types that other libraries derive (such as ``mitsuba.Point3f``) are resolved through their components.
    """
    leaf = array
    while dr.depth_v(leaf) > 1 and not dr.is_tensor_v(leaf):
        leaf = leaf[0]
    return sys.modules[type(leaf).__module__]

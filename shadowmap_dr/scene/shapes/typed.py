"""Functions of Dr.Jit with the types that its stubs lack."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import drjit as dr

from ...jit.types import AnyArray, ArrayT, Float


def ravel(array: AnyArray) -> Float:
    """``dr.ravel`` of floating-point arrays: components interleaved, C order. Attached."""
    return cast("Float", dr.ravel(array))


def replace_grad(value: ArrayT, source: ArrayT) -> ArrayT:
    """``dr.replace_grad``: the numbers of ``value`` with the derivatives of ``source``."""
    return cast(Callable[[ArrayT, ArrayT], ArrayT], dr.replace_grad)(value, source)

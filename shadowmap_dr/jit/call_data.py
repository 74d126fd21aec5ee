"""Scalar members of Mitsuba's objects, made safe for calls in a frozen function."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from types import ModuleType
from typing import cast

import drjit as dr
import mitsuba as mi

from .arrays import own_memory
from .types import AnyArray

# Names of types in the output of `dr.whos`, and their names in a module such as ``drjit.llvm.ad``. Unsigned 64-bit integers are
# missing on purpose: they are handles of textures on a GPU, which may not be replaced.
_TYPES = {
    "bool": "Bool", "i8": "Int8", "u8": "UInt8", "i32": "Int", "u32": "UInt", "i64": "Int64",
    "f16": "Float16", "f32": "Float", "f64": "Float64",
}  # fmt: skip


def rewrite_scalars(nodes: Iterable[mi.Object]) -> None:
    """Replace all evaluated scalars of Mitsuba's objects by copies that a kernel has written, while a function is recorded.

    Dr.Jit 1.5 forgets the type of a scalar that was filled with a constant during the recording. Calls through pointers
    (``mi.BSDFPtr``) copy such members of their instances, but a replay copies none of their bytes, so that the call reads
    uninitialised memory. A texture that is given new data holds its resolution in such scalars. ``docs/dr-jit-faults`` has a
    script that shows the fault. Values do not change. Attached scalars are kept: users set them before the recording.

    Args:
        nodes: objects whose methods are called through pointers, and the objects that they hold.
    """
    if not dr.flag(dr.JitFlag.FreezingScope):
        return
    unique = list({id(node): node for node in nodes}.values())
    found: list[int] = []
    with dr.scoped_set_flag(dr.JitFlag.EnableObjectTraversal, True):
        for node in unique:
            node._traverse_1_cb_ro(lambda index, variant, domain: found.append(index))
        copies = _copies(found)
        dr.eval(list(copies.values()))
        for node in unique:
            node._traverse_1_cb_rw(lambda index, variant, domain: _index(copies[index]) if index in copies else index)


def _copies(indices: Iterable[int]) -> Mapping[int, AnyArray]:
    """Copies of evaluated scalars without gradients. The upper 32 bits of an index are that of the AD variable."""
    module, types, copies = sys.modules[mi.Float.__module__], _types_now(), {}
    # Not by `dr.grad_enabled`, which is false wherever gradients are suspended.
    for index in {index for index in indices if index >> 32 == 0}:
        kind = _kind(module, types.get(index & 0xFFFFFFFF))
        array = None if kind is None else cast(AnyArray, dr.detail.update_indices(kind(0), [index]))
        if array is not None and len(array) == 1 and array.state == dr.VarState.Evaluated:
            copies[index] = own_memory(array)
    return copies


def _types_now() -> dict[int, str]:
    """Names of the types of all live variables, by index."""
    rows = [line.split() for line in (dr.whos(True) or "").splitlines()]
    return {int(row[0]): row[2] for row in rows if len(row) > 2 and row[0].isdigit()}


def _kind(module: ModuleType, name: str | None) -> type[AnyArray] | None:
    return None if name is None else getattr(module, _TYPES.get(name, ""), None)


def _index(array: AnyArray) -> int:
    return int(getattr(array, "index_ad", 0)) << 32 | int(array.index)

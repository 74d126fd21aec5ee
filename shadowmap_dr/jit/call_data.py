"""Scalar members of Mitsuba's objects, made safe for calls in a frozen function."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
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
        scalars = _scalars(found)
        copies = {index: own_memory(scalar) for index, scalar in scalars.items()}
        dr.eval(list(copies.values()))
    _replace(unique, copies)
    if _ORIGINALS:
        nodes_so_far, originals = _ORIGINALS[-1]
        nodes_so_far += unique
        originals |= {_index(copy): originals.get(index, scalars[index]) for index, copy in copies.items()}


@contextmanager
def restored_scalars() -> Iterator[None]:
    """Context at whose end Mitsuba's objects have the scalars again that :func:`rewrite_scalars` has replaced in it.

    A replay gives objects new arrays where their recording has left others than it found. ``params.update()`` would then tell all
    these objects that they have changed: some compute tables anew, and ``principled`` switches on all of its lobes.
    """
    _ORIGINALS.append(([], {}))
    try:
        yield
    finally:
        nodes, originals = _ORIGINALS.pop()
        _replace({id(node): node for node in nodes}.values(), originals)


# For each `restored_scalars`, objects whose scalars were replaced, and the scalars of before by the numbers of the others.
_ORIGINALS: list[tuple[list[mi.Object], dict[int, AnyArray]]] = []


def _replace(nodes: Iterable[mi.Object], others: Mapping[int, AnyArray]) -> None:
    """Replace arrays of Mitsuba's objects by others, by their numbers."""
    with dr.scoped_set_flag(dr.JitFlag.EnableObjectTraversal, True):
        for node in nodes:
            node._traverse_1_cb_rw(lambda index, variant, domain: _index(others[index]) if index in others else index)


def _scalars(indices: Iterable[int]) -> dict[int, AnyArray]:
    """Evaluated scalars without gradients. The upper 32 bits of an index are that of the AD variable."""
    module, types, scalars = sys.modules[mi.Float.__module__], _types_now(), {}
    # Not by `dr.grad_enabled`, which is false wherever gradients are suspended.
    for index in {index for index in indices if index >> 32 == 0}:
        kind = _kind(module, types.get(index & 0xFFFFFFFF))
        array = None if kind is None else cast(AnyArray, dr.detail.update_indices(kind(0), [index]))
        if array is not None and len(array) == 1 and array.state == dr.VarState.Evaluated:
            scalars[index] = array
    return scalars


def _types_now() -> dict[int, str]:
    """Names of the types of all live variables, by index."""
    rows = [line.split() for line in (dr.whos(True) or "").splitlines()]
    return {int(row[0]): row[2] for row in rows if len(row) > 2 and row[0].isdigit()}


def _kind(module: ModuleType, name: str | None) -> type[AnyArray] | None:
    return None if name is None else getattr(module, _TYPES.get(name, ""), None)


def _index(array: AnyArray) -> int:
    return int(getattr(array, "index_ad", 0)) << 32 | int(array.index)

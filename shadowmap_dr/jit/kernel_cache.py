"""Letting go of kernels: those of an image depend on its size, and Dr.Jit keeps all of them for as long as the process lives."""

from __future__ import annotations

import threading
from collections.abc import Hashable

import drjit as dr

# A size has about 1 MiB of kernels. Loops over this many sizes keep all of theirs.
_MOST_SIZES = 64

_sizes: set[Hashable] = set()


def note_size(size: Hashable) -> None:
    """Note that an image of some size is about to be rendered; let all kernels go where there have been many sizes.

    Kernels that are needed again come from Dr.Jit's files; recordings find theirs again. Nothing is let go while a function is
    recorded, or while there are other Python threads: one of them may be running a kernel.

    Args:
        size: tells apart images that need kernels of their own.
    """
    if dr.flag(dr.JitFlag.FreezingScope):
        return
    if size not in _sizes and len(_sizes) >= _MOST_SIZES and threading.active_count() == 1:
        dr.sync_thread()
        dr.flush_kernel_cache()
        _sizes.clear()
    _sizes.add(size)

"""A limit on cached kernels: sizes of images and counts of samples have some of their own, which Dr.Jit keeps until it ends.

Most kernels serve all sizes (:mod:`shadowmap_dr.jit.kernel_inputs`), those of loops of callers often do not.
"""

from __future__ import annotations

import threading
from collections.abc import Hashable

import drjit as dr

# A size may have 1 MiB of kernels. A loop over at most this many sizes keeps all of its kernels.
_MOST_SIZES = 64

_sizes: set[Hashable] = set()


def note_size(size: Hashable) -> None:
    """Note that an image of some size is about to be rendered; flush Dr.Jit's kernel cache after many sizes.

    Dr.Jit loads flushed kernels again from its files, also for frozen functions. The cache is not flushed while a function is
    recorded, or while there are other Python threads: one of them may be running a kernel.

    Args:
        size: key that differs between images with different kernels.
    """
    if dr.flag(dr.JitFlag.FreezingScope):
        return
    if size not in _sizes and len(_sizes) >= _MOST_SIZES and threading.active_count() == 1:
        dr.sync_thread()
        dr.flush_kernel_cache()
        _sizes.clear()
    _sizes.add(size)

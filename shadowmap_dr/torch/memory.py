"""The C library's memory for tensors on the CPU: blocks that are freed serve again."""

from __future__ import annotations

import ctypes
import os
import sys

# Parameters of glibc's `mallopt`, from `malloc.h`; variables by which users set them.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
_VARIABLES = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES")
# Bytes. Larger blocks are mapped for themselves, glibc allows no more; free memory at the end of the heap up to which it is kept.
_LARGEST, _KEPT = 1 << 25, 1 << 28


def keep_freed_blocks() -> bool:
    """Let glibc keep freed blocks of up to 32 MiB, at most 256 MiB in all, instead of returning them to the system.

    PyTorch's temporary tensors, three or four of an image's size for a loss, get new memory at each step otherwise, which the
    system clears page by page: a fifth of a step at 512 x 512. Of the whole process.

    Returns:
        False, and nothing is changed, on other systems, with another C library, and where the user's environment sets this.
    """
    if not sys.platform.startswith("linux") or any(name in os.environ for name in _VARIABLES):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    return bool(mallopt(_MMAP_THRESHOLD, _LARGEST) and mallopt(_TRIM_THRESHOLD, _KEPT))

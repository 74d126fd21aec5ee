"""Dr.Jit 1.5 (LLVM): kernels read beyond the end of memory that Dr.Jit borrows from NumPy.

They read vectors of 16 numbers, the last one whole. Where the array ends at a page that the process may not read, the process is
lost. Right: it goes on. ``borrowed_memory.py numbers``: the same numbers through a list, which Dr.Jit copies.
"""

import ctypes
import mmap
import sys

import drjit as dr
import numpy as np
from drjit.llvm.ad import Float

pages = mmap.mmap(-1, 2 * mmap.PAGESIZE)
memory = np.frombuffer(pages, np.uint8)
libc = ctypes.CDLL(None, use_errno=True)
assert libc.mprotect(ctypes.c_void_p(memory.ctypes.data + mmap.PAGESIZE), mmap.PAGESIZE, 0) == 0
values = memory[mmap.PAGESIZE - 4 * 5 : mmap.PAGESIZE].view(np.float32)  # five numbers before the end
array = Float(values.tolist() if sys.argv[1:] == ["numbers"] else values) + dr.opaque(Float, 1)
print("borrowed_memory: wrong if nothing follows", flush=True)
dr.eval(array)
dr.sync_thread()
print("borrowed_memory: right")

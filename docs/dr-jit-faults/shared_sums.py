"""Dr.Jit 1.5 (LLVM): sums by ``scatter_add`` lose terms when several Python threads wait for Dr.Jit at the same time.

Each worker adds to a copy of its own of a small target. All threads that are no workers have the same number, and help while they
wait: two of them add to one copy, not atomically. Right: no sum is wrong.
"""

import threading
import time

import drjit as dr
from drjit.llvm.ad import Float, UInt32

SIZE, SECONDS = 1 << 18, 5
wrong, sums = [0], [0]


def work() -> None:
    index = dr.arange(UInt32, SIZE) % 4
    dr.make_opaque(index)
    start = time.monotonic()
    while time.monotonic() - start < SECONDS:
        total = dr.zeros(Float, 4)
        dr.scatter_reduce(dr.ReduceOp.Add, total, dr.opaque(Float, 1, SIZE), index)
        sums[0] += 1
        wrong[0] += bool((total.numpy() != SIZE // 4).any())


threads = [threading.Thread(target=work) for _ in range(4)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
print("shared_sums:", f"{wrong[0]} of {sums[0]} sums wrong" if wrong[0] else f"right, {sums[0]} sums")

"""Dr.Jit 1.5: a call in a replayed function reads scalars that were filled with a constant from uninitialised memory.

``c`` is filled by a memset while the function is recorded. The recording does not know its type, and a replay copies no byte of
it to where the callables look it up. Right: 3 everywhere.
"""

import drjit as dr
from drjit.llvm.ad import Float, UInt32


@dr.freeze
def product(index: UInt32, x: Float) -> Float:
    c = dr.opaque(Float, 3)
    return dr.switch(index, [lambda x: x * c, lambda x: x * c], x)


kept, wrong = [], 0
for _ in range(6):
    x, index = dr.opaque(Float, 1, 8), dr.arange(UInt32, 8) % 2
    dr.make_opaque(index)
    result = product(index, x)
    wrong += not dr.allclose(result, 3)
    kept += [dr.opaque(Float, -777) for _ in range(30)]  # so that memory is not what it was by chance
print("constant_scalars:", f"{wrong} of 6 calls wrong" if wrong else "right")

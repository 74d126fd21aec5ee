"""Dr.Jit 1.5: a graph with a symbolic branch that reads an attached array is not traversed again for another tangent.

Right: derivatives 0, 1, 2, 3 twice.
"""

import drjit as dr
from drjit.llvm.ad import Float, UInt32

number = Float(2)
dr.enable_grad(number)
table = dr.arange(Float, 4) * number
result = dr.if_stmt(
    (dr.arange(UInt32, 4),),
    dr.arange(UInt32, 4) < 4,
    lambda index: dr.gather(Float, table, index),
    lambda index: Float(0),
    mode="symbolic",
)
found: list[list[float]] = []
try:
    for _ in range(2):
        dr.set_grad(number, 1)
        dr.forward_to(result, flags=dr.ADFlag.ClearVertices)
        found.append(dr.grad(result).numpy().tolist())
        dr.clear_grad(result)
    print("second traversals:", "right" if found == 2 * [[0, 1, 2, 3]] else f"wrong, {found}")
except RuntimeError as error:
    print(f"second traversals: wrong, after {len(found)} of 2: {str(error)[:80]}")

"""The reciprocal of a double is good for some 20 bits, on a GPU."""

import drjit as dr
import numpy as np
from drjit.cuda import Float64

x = np.random.default_rng(0).uniform(1, 2, 1000)
error = np.abs(dr.rcp(Float64(x)).numpy() * x - 1).max()
with dr.scoped_set_flag(dr.JitFlag.FastMath, False):
    exact = np.abs(dr.rcp(Float64(x)).numpy() * x - 1).max()
print(f"largest error {error:.1e}, without fast math {exact:.1e}")
print("right" if error < 1e-14 else "wrong")

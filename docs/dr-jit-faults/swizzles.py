"""Dr.Jit 1.5: vectors have an attribute for each name that ends in x, y or z.

``v.xy`` names components. So does, in place of an error, ``v.matrix``: as often as the name has letters, the first one.
"""

from drjit.llvm.ad import Array3f

v = Array3f(1, 2, 3)
print("swizzles:", "wrong, a vector has a matrix" if hasattr(v, "matrix") else "right")

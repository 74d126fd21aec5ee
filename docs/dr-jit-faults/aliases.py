"""Dr.Jit 1.5: a recording does not know which of its earlier inputs an input is, if it is one of them.

It then replays what it recorded with another one. Small numbers, True, False, None and most strings are single objects in
Python, so that they count as well as arrays. Right: 2, 3 and 1, 2.
"""

from typing import Any

import drjit as dr
from drjit.llvm.ad import Float


@dr.freeze
def last(both: Any, one: Any, x: Float) -> Float:
    return x * one


x, two, three = dr.opaque(Float, 1), dr.opaque(Float, 2), dr.opaque(Float, 3)
arrays = [float(last((two, three), array, x)[0]) for array in (two, three)]
numbers = [float(last((1, 2), number, x)[0]) for number in (1, 2)]
print("aliases:", "right" if (arrays, numbers) == ([2, 3], [1, 2]) else f"wrong, {arrays} and {numbers}")

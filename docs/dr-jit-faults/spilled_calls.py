"""A kernel that keeps many numbers and calls functions does not compile, and ends the process: GPUs of compute capability 7.5 on,
compilers since CUDA 13."""

import drjit as dr
from drjit.cuda import ArrayXf, Float, UInt32


def first(x: Float) -> Float:
    return dr.sin(x)


def second(x: Float) -> Float:
    return dr.cos(x) + x


index = dr.arange(UInt32, 4096)
kept = [Float(index) * (0.1 * k) for k in range(300)]
total = Float(0)
for _ in range(3):
    total += dr.switch(index % 2, [first, second], total)
    kept = [dr.fma(value, total, value) for value in kept]
result = ArrayXf(kept)
dr.eval(result)
print("right" if dr.all(result[0] == 0) else "wrong")

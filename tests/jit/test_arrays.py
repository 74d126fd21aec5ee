"""``jit.arrays``: arrays of NumPy's become ones of Dr.Jit's own, wherever they lie."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from unaligned import unaligned

from shadowmap_dr.jit.arrays import device_array, own_memory
from shadowmap_dr.raster.topology import build_topology


def kernels(call: Any) -> list[str]:
    """Names of the kernels that a call runs."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        dr.eval(call())
        return [entry["hash"] for entry in dr.kernel_history() if "hash" in entry]


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.uint32, np.int64, np.bool_])
@pytest.mark.parametrize("kind", ["Float", "UInt32", "Bool"])
def test_numbers_arrive(variant: str, kind: str, dtype: type) -> None:
    values = np.arange(24).reshape(2, 3, 4).astype(dtype)
    for given in (values, values.transpose(2, 0, 1), values[:, ::2, ::-1], values[:0], values.tolist()):
        found = device_array(getattr(mi, kind), given)
        assert type(found) is getattr(mi, kind)
        expected = np.ravel(given).astype(found.numpy().dtype)
        np.testing.assert_array_equal(found.numpy(), expected)


def test_the_memory_is_not_numpys(variant: str) -> None:
    values = unaligned(np.arange(4_000_000, dtype=np.float32))
    found = device_array(mi.Float, values)
    values[-1000:] = -1  # at once: Dr.Jit has not yet read them
    np.testing.assert_array_equal(found.numpy(), np.arange(4_000_000))

    values[:] = np.arange(4_000_000)
    tensor = own_memory(mi.TensorXf(values.reshape(1000, 4000)))
    dr.sync_thread()
    values[:] = -1
    np.testing.assert_array_equal(tensor.numpy(), np.arange(4_000_000).reshape(1000, 4000))


def test_kernels_do_not_depend_on_where_numbers_came_from(variant: str) -> None:
    values = np.arange(1000, dtype=np.float32)
    arrays = [device_array(mi.Float, unaligned(values, offset)) for offset in (0, 1, 4)]
    run = [kernels(lambda array=array: dr.sin(array) * 3) for array in arrays]
    assert len(run[0]) == 1 and run[0] == run[1] == run[2]


def test_topologies_are_in_memory_of_dr_jits_own(variant: str) -> None:
    """A pass over a mesh must not be compiled once more because its faces have come to lie elsewhere."""
    faces, positions = np.array([[0, 1, 2], [2, 1, 3]]), np.random.default_rng(0).uniform(-1, 1, (4, 3))
    run = []
    for _ in range(8):  # where NumPy's memory lies differs by chance
        topology = build_topology(faces, positions, mi.UInt32)
        arrays = (topology.edges, topology.opposite, topology.faces, topology.welded, topology.parts, topology.beyond)
        run.append([kernels(lambda array=array: array * 5 + 1) for array in arrays])
    assert all(names == run[0] for names in run)
    aligned = device_array(mi.UInt32, faces)
    assert run[0][2] == kernels(lambda: aligned * 5 + 1) and run[0][2]


def test_gradients_do_not_flow(variant: str) -> None:
    array = mi.Float([1, 2, 3])
    dr.enable_grad(array)
    assert not dr.grad_enabled(own_memory(array))


# Numbers that end where memory ends that the process may read.
GUARDED = """
import ctypes, mmap, sys
import mitsuba as mi
import numpy as np
mi.set_variant("llvm_ad_rgb")
import drjit as dr
from shadowmap_dr.jit.arrays import device_array, own_memory

def guarded(values):
    pages = -(-values.nbytes // mmap.PAGESIZE)
    memory = np.frombuffer(mmap.mmap(-1, (pages + 1) * mmap.PAGESIZE), np.uint8)
    end = pages * mmap.PAGESIZE
    assert ctypes.CDLL(None).mprotect(ctypes.c_void_p(memory.ctypes.data + end), mmap.PAGESIZE, 0) == 0
    result = memory[end - values.nbytes : end].view(values.dtype)
    result[:] = values
    return result

count = int(sys.argv[1])
for kind, dtype in ((mi.Float, np.float32), (mi.UInt32, np.uint32), (mi.Bool, np.bool_)):
    values = guarded((np.arange(count) % 2).astype(dtype))
    for found in (device_array(kind, values), own_memory(kind(values))):
        assert (np.asarray(found) == values).all() and dr.width(found) == count
tensor = own_memory(mi.TensorXf(guarded(np.arange(count, dtype=np.float32)).reshape(-1, 1)))
assert tensor.shape == (count, 1) and (np.asarray(tensor).ravel() == np.arange(count)).all()
"""


@pytest.mark.parametrize("count", [5, 300_005])
def test_memory_beyond_the_end_is_not_read(count: int) -> None:
    """Dr.Jit's kernels for CPUs read whole vectors: programs ended once in a few hundred times."""
    result = subprocess.run([sys.executable, "-c", GUARDED, str(count)], capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr

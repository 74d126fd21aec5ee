"""Behaviour without PyTorch, and when it is loaded."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import pytest

from shadowmap_dr.errors import install_hint

# Prints whether freed memory is kept, and the number of new pages of a step.
TEMPORARY = """
import resource
import shadowmap_dr.torch, torch
from shadowmap_dr.torch.memory import keep_freed_blocks
def step():
    image = torch.ones(512 * 512 * 3, requires_grad=True)
    (image - 0.5).square().mean().backward()
for _ in range(10):
    step()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    step()
print(keep_freed_blocks(), (resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before) // 20)
"""


def test_one_sentence_says_how_to_get_it() -> None:
    code = "import sys; sys.modules['torch'] = None; import shadowmap_dr, shadowmap_dr.torch"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert result.returncode == 1
    last = result.stderr.strip().splitlines()[-1]
    assert last == f"ImportError: shadowmap_dr.torch needs PyTorch: {install_hint('torch')}."


def test_the_package_does_not_load_it() -> None:
    code = "import sys, shadowmap_dr; assert 'torch' not in sys.modules"
    assert subprocess.run([sys.executable, "-c", code], timeout=120).returncode == 0


@pytest.mark.parametrize(
    ("before", "set_before", "policy"), [("", None, "PASSIVE"), ("", "ACTIVE", "ACTIVE"), ("import torch", None, "None")]
)
def test_waiting_threads_of_pytorch_sleep(before: str, set_before: str | None, policy: str) -> None:
    """PyTorch reads the variable when it is loaded, and nobody's choice is changed."""
    pytest.importorskip("torch")
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    if set_before is not None:
        environment["OMP_WAIT_POLICY"] = set_before
    code = f"import os\n{before}\nimport shadowmap_dr.torch\nprint(os.environ.get('OMP_WAIT_POLICY'))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, env=environment)
    assert result.stdout.split() == [policy]


@pytest.mark.parametrize("name", [None, "MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES"])
def test_temporary_tensors_get_memory_that_was_freed(name: str | None) -> None:
    """Pages that the system hands out are counted, for tensors of images of 512 x 512. Nobody's choice is changed."""
    pytest.importorskip("torch")
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("MALLOC_", "GLIBC_"))}
    if name is not None:
        environment[name] = "" if name.startswith("GLIBC") else "131072"
    result = subprocess.run([sys.executable, "-c", TEMPORARY], capture_output=True, text=True, timeout=120, env=environment)
    kept, pages = result.stdout.split()
    expected = name is None and platform.libc_ver()[0] == "glibc"
    assert kept == str(expected)
    assert not expected or int(pages) < 500  # 5,000 without

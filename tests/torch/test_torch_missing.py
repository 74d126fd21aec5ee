"""Behaviour without PyTorch, and when it is loaded."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from shadowmap_dr.errors import install_hint


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

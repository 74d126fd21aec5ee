"""Behaviour without PyTorch."""

from __future__ import annotations

import subprocess
import sys

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

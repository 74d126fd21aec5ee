"""Kernels of tests are kept apart from those of users, which are compiled with all of LLVM's passes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import drjit as dr
import mitsuba as mi
import pytest

KERNELS = Path(__file__).parent.parent / ".pytest_cache" / "kernels"
# A kernel that no other test has, and that is no longer in memory when the next test wants it.
NUMBER = f"1.25{os.getpid()}"
ONE = f"import drjit as dr, mitsuba as mi; mi.set_variant('llvm_ad_rgb'); dr.eval(mi.Float(1, 2) * {NUMBER} + 7)"


@pytest.mark.skipif(os.environ.get("SHADOWMAP_TESTS_OPTIMIZE", "0") != "0", reason="kernels are users' by wish")
def test_kernels_of_tests_have_a_folder_of_their_own(tmp_path: Path) -> None:
    if not dr.has_backend(dr.JitBackend.LLVM):
        pytest.skip("no LLVM")
    mi.set_variant("llvm_ad_rgb")
    before = set(KERNELS.rglob("*.bin"))
    dr.eval(mi.Float(1, 2) * float(NUMBER) + 7)
    dr.sync_thread()
    assert set(KERNELS.rglob("*.bin")) - before
    # What a test starts neither finds that kernel nor adds to the folder.
    users = tmp_path / "users"
    users.mkdir()
    environment = {**os.environ, "HOME": str(users)}
    subprocess.run([sys.executable, "-c", "import shadowmap_dr; " + ONE], check=True, env=environment)
    assert list(users.rglob("*.bin"))

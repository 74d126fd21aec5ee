"""Kernels of tests are kept apart from those of users, which are compiled with all of LLVM's passes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import drjit as dr
import mitsuba as mi
import pytest
import quick_kernels
from quick_kernels import FOLDER, without_messages


@pytest.mark.skipif(os.environ.get("SHADOWMAP_TESTS_OPTIMIZE", "0") != "0", reason="kernels are users' by wish")
def test_kernels_of_tests_have_a_folder_of_their_own(tmp_path: Path) -> None:
    if not dr.has_backend(dr.JitBackend.LLVM):
        pytest.skip("no LLVM")
    mi.set_variant("llvm_ad_rgb")
    before = set(FOLDER.rglob("*.bin"))
    dr.eval(mi.Float(1, 2) * (1 + os.getpid()) + 7)  # that no other test has
    dr.sync_thread()
    assert set(FOLDER.rglob("*.bin")) - before
    code = "import shadowmap_dr, drjit as dr, mitsuba as mi; mi.set_variant('llvm_ad_rgb'); dr.eval(mi.Float(1, 2) * 2)"
    subprocess.run([sys.executable, "-c", code], check=True, env={**os.environ, "HOME": str(tmp_path)})
    assert not list(tmp_path.rglob("*.bin"))


@pytest.mark.skipif(os.environ.get("SHADOWMAP_TESTS_OPTIMIZE", "0") != "0", reason="kernels are users' by wish")
def test_messages_are_written_as_whole_lines(capfd: pytest.CaptureFixture[str]) -> None:
    if not dr.has_backend(dr.JitBackend.LLVM):
        pytest.skip("no LLVM")
    mi.set_variant("llvm_ad_rgb")
    quick_kernels.flush_messages()
    capfd.readouterr()
    dr.eval(mi.Float(1, 2) * (2 + os.getpid()) + 9)  # that no other test has
    dr.sync_thread()
    quick_kernels.flush_messages()
    written = capfd.readouterr().err
    assert written.startswith("BISECT: NOT running pass (") and written.endswith("\n")
    assert without_messages(written) == ""
    quick_kernels.flush_messages()
    assert capfd.readouterr().err == ""


def test_what_llvm_says_of_passes_is_not_a_tests_output() -> None:
    said = "BISECT: NOT running pass (7) Stack Slot Coloring on function (drjit_0)\n"
    assert without_messages(said + "one\n" + said + "two BISECT: \n") == "one\ntwo BISECT: \n"

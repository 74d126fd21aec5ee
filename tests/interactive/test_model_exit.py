"""Programs that end while a session's threads still work."""

from __future__ import annotations

import subprocess
import sys

import pytest

# The mesh never rests, so the thread is in a step when the main thread ends.
SESSION = """
import sys, time
import mitsuba as mi
import shadowmap_dr
mi.set_variant("llvm_ad_rgb")
from shadowmap_dr.interactive import Modeller, Session, modeller
from shadowmap_dr.interactive.file_session import kept
from shadowmap_dr.inverse import Sculptor, even_sphere, shadow_view

modeller.PATIENCE = modeller.MOST_STEPS = 10**9
session = Session(lambda: Modeller(Sculptor(*even_sphere(30), [shadow_view(size=128)], map_resolution=128, filter_size=3)))
session.start()
wanted = session.snapshot.shadow / 255
wanted[40:60, 48:84] = 0
session.set_target(wanted, 1)
while session.snapshot.steps < 10:
    time.sleep(0.01)
"""
KEEPER = """
from shadowmap_dr.interactive import file_session
file_session.SAVE_INTERVAL = 0.001
keeping = kept(session, lambda snapshot: snapshot.vertices.copy())
keeping.__enter__()
"""
ENDS = {
    "at the end": ("", 0),
    "with an exit status": ("sys.exit(3)", 3),
    "with an error": ("raise ValueError('the program has a fault')", 1),
    "with two threads": (KEEPER, 0),
    "closed twice": ("session.close(); session.close()", 0),
}


@pytest.mark.parametrize("end", ENDS)
def test_programs_that_leave_a_session_open_end_in_order(end):
    pytest.importorskip("cholespy")
    import drjit as dr

    if not dr.has_backend(dr.JitBackend.LLVM):
        pytest.skip("no LLVM")
    code, status = ENDS[end]
    for _ in range(2):
        result = subprocess.run([sys.executable, "-c", SESSION + code], capture_output=True, text=True, timeout=120)
        assert result.returncode == status, result.stderr
        assert "terminate" not in result.stderr

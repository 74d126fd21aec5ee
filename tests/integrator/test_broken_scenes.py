"""Broken scenes do not end the process: images are finite where the scene is, errors are one line."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from broken_scenes import CASES
from quick_kernels import without_messages

SCRIPT = Path(__file__).parents[1] / "support" / "broken_scenes.py"


@pytest.fixture(scope="module")
def outcomes() -> dict[str, str]:
    """Name of the case -> what came of it. All of them in one process of their own, which they could have ended."""
    code = f"import quick_kernels, runpy; runpy.run_path({str(SCRIPT)!r}, run_name='__main__')"
    run = subprocess.run([sys.executable, "-c", code], cwd=SCRIPT.parent, capture_output=True, text=True, timeout=600)
    said = without_messages(run.stderr)
    found = dict(re.findall(r"@(\w+) (.*)", run.stdout))
    begun = re.findall(r"@(\w+)$", run.stdout, re.MULTILINE)
    assert run.returncode == 0, f"'{begun[-1] if begun else 'start'}' ended the process ({run.returncode}): {said[-500:]}"
    assert "Traceback" not in said and "RuntimeWarning" not in said, said[-2000:]
    return found


@pytest.mark.parametrize("name", CASES)
def test_outcome(outcomes: dict[str, str], name: str) -> None:
    _, wanted = CASES[name]
    assert outcomes[name].startswith(f"{wanted}:"), outcomes[name]

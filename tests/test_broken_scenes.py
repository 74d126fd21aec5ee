"""What is broken in a scene does not end the process: images are finite where the scene is, errors are one line."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from broken_scenes import CASES

SCRIPT = Path(__file__).parent / "broken_scenes.py"


@pytest.fixture(scope="module")
def outcomes() -> dict[str, str]:
    """Name of the case -> what came of it. All of them in one process of their own, which they could have ended."""
    run = subprocess.run([sys.executable, str(SCRIPT)], capture_output=True, text=True, timeout=600)
    found = dict(re.findall(r"@(\w+) (.*)", run.stdout))
    begun = re.findall(r"@(\w+)$", run.stdout, re.MULTILINE)
    assert run.returncode == 0, f"'{begun[-1] if begun else 'start'}' ended the process ({run.returncode}): {run.stderr[-500:]}"
    assert "Traceback" not in run.stderr and "RuntimeWarning" not in run.stderr, run.stderr[-2000:]
    return found


@pytest.mark.parametrize("name", CASES)
def test_outcome(outcomes: dict[str, str], name: str) -> None:
    _, wanted = CASES[name]
    assert outcomes[name].startswith(f"{wanted}:"), outcomes[name]

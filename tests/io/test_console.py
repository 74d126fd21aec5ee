"""Output of commands on terminals and pipes."""

from __future__ import annotations

import io
import time

import pytest
from rich.console import Console

from shadowmap_dr.io import console


@pytest.mark.parametrize("terminal", [False, True])
def test_progress_is_seen_in_pipes_too(terminal: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(console, "_LINE_SECONDS", 0.02)
    written = io.StringIO()
    with console.progress(Console(file=written, force_terminal=terminal)) as progress:
        task = progress.add_task("scenes", total=3, note="desk")
        progress.advance(task)
        limit = time.monotonic() + 10
        while "1/3 desk" not in written.getvalue() and not terminal and time.monotonic() < limit:
            time.sleep(0.01)
    lines = written.getvalue().splitlines()
    assert ("scenes 1/3 desk, 0:00" in lines) != terminal
    assert not progress._lines.is_alive()

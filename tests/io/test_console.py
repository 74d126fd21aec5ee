"""Output of commands on terminals and pipes."""

from __future__ import annotations

import io
import time

import pytest
from rich.console import Console

from shadowmap_dr.errors import Verbosity, set_verbosity
from shadowmap_dr.io import console


def test_tables_are_whole_in_pipes(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    row = ["a long first column of words " * 4, *(f"{k}.000000001" for k in range(12))]
    console.show(console.table("Title", ["first", *map(str, range(12))], [row]))
    assert any(all(cell.strip() in line for cell in row) for line in capsys.readouterr().out.splitlines())


def test_quiet_commands_print_no_notes(capsys: pytest.CaptureFixture[str]) -> None:
    try:
        for level in (Verbosity.QUIET, Verbosity.USUAL):
            set_verbosity(level)
            console.note(f"[level] {level.name}")
            with console.progress(console.notes()) as progress:
                progress.add_task(f"task {level.name}", total=1, note="")
    finally:
        set_verbosity(Verbosity.USUAL)
    shown = capsys.readouterr()
    assert "QUIET" not in shown.err and "[level] USUAL" in shown.err and "task USUAL" in shown.err and shown.out == ""


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

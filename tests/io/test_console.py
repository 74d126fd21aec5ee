"""Output of commands on terminals and pipes."""

from __future__ import annotations

import io
import time
from collections.abc import Callable

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


@pytest.mark.parametrize("terminal", [False, True])
def test_long_steps_are_named_with_their_time(terminal: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(console, "_LINE_SECONDS", 0.05)
    written = io.StringIO()
    with console.progress(Console(file=written, force_terminal=terminal, width=200)) as progress:
        task = progress.add_task("run 0", total=3, note="kernels are compiled")
        _wait(lambda: "run 0 0/3 kernels are compiled, at step 1 for 0 s" in written.getvalue())
        progress.update(task, completed=1, note="")
        _wait(lambda: "run 0 1/3, at step 2 for 0 s" in written.getvalue())
        with console.task(progress, "path-traced reference"):
            _wait(lambda: "path-traced reference, for 0 s" in written.getvalue())
        assert len(progress.tasks) == 1
    if terminal:  # a bar is seen there: a line for each long step is enough
        assert written.getvalue().count("at step 1 for") == 1


def test_waits_are_named_with_their_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(console, "_LINE_SECONDS", 0.02)
    said: list[str] = []
    with console.waiting(said.append, lambda seconds: f"for {seconds:.2f} s" if len(said) < 2 else None):
        _wait(lambda: len(said) == 2)
    times = [float(line.split()[1]) for line in said]
    assert 0.02 <= times[0] < times[1]
    time.sleep(0.1)
    assert len(said) == 2
    with pytest.raises(KeyError), console.waiting(said.append, str):
        raise KeyError


def _wait(done: Callable[[], bool]) -> None:
    limit = time.monotonic() + 20
    while not done():
        assert time.monotonic() < limit
        time.sleep(0.01)

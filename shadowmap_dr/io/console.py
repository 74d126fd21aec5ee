"""Tables and progress displays for the terminal, and tables in Markdown."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from time import monotonic
from typing import Literal

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.measure import Measurement
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from ..errors import Verbosity, verbosity

# Seconds between lines of progress where there is no terminal to draw a bar on.
_LINE_SECONDS = 10.0
# Columns between two columns of a table.
_GAP = 2
# Width of the widest table in a pipe.
_WIDEST = 1000


def notes() -> Console:
    """Console for progress and notes, on standard error; it prints nothing with ``--quiet``."""
    return Console(stderr=True, quiet=verbosity() is Verbosity.QUIET)


def note(text: str) -> None:
    """Print a line beside the results, on standard error, unless commands are quiet."""
    notes().print(text, soft_wrap=True, highlight=False, markup=False)


def show(result: Table) -> None:
    """Print a table of results, in a pipe as wide as it is: no cell is wrapped there."""
    console = Console()
    if not console.is_terminal:
        console.width = max(console.width, Measurement.get(console, console.options.update(max_width=_WIDEST), result).maximum)
    fit(result, console.width)
    console.print(result)


def fit(result: Table, width: int) -> None:
    """Share the room of a terminal among the wrapped columns of a table, so that no column loses a word if that is possible.

    Rich itself narrows columns below their longest words, and cuts the last ones off.
    """
    natural = [
        max(len(line) for cell in (*column.cells, column.header) for line in str(cell).split("\n")) for column in result.columns
    ]
    needed = [
        whole if column.no_wrap else column.min_width or whole for whole, column in zip(natural, result.columns, strict=True)
    ]
    room = width - _GAP * (len(natural) - 1) - sum(needed)
    wanted = sum(natural) - sum(needed)
    if 0 <= room < wanted:
        for whole, least, column in zip(natural, needed, result.columns, strict=True):
            column.width = least + (whole - least) * room // wanted


def result(picture: Path | None = None, record: Path | None = None) -> None:
    """Print the last line of a command: the picture to look at, and the record."""
    named = {"picture": picture, "record": record}
    line = ", ".join(f"{name}: {path}" for name, path in named.items() if path is not None)
    print(line[0].upper() + line[1:])


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], wrapped: Collection[int] = (0,)) -> Table:
    """A table for the terminal: the first column left-aligned, all others right-aligned.

    Columns of the numbers ``wrapped`` are wrapped between words where the terminal is narrow.
    """
    result = Table(title=title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, show_edge=False)
    for i, column in enumerate(columns):
        longest = max((len(word) for row in (columns, *rows) for word in row[i].split()), default=0)
        justify: Literal["left", "right"] = "left" if i == 0 else "right"
        result.add_column(column, justify=justify, no_wrap=i not in wrapped, min_width=longest if i in wrapped else None)
    for row in rows:
        result.add_row(*row)
    return result


def progress(console: Console) -> Progress:
    """A progress display. Add one task for each part of the work, with a text in its field `note`.

    Without a terminal (in a pipe, in a file) it writes a line every ten seconds. On a terminal, a step that takes longer
    than that has a line of its own.
    """
    return _ProgressOrLines(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[note]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
    )


@contextmanager
def task(display: Progress, description: str) -> Iterator[None]:
    """A task without steps, shown while a block runs."""
    number = display.add_task(description, total=None, note="")
    try:
        yield
    finally:
        display.remove_task(number)


class _ProgressOrLines(Progress):
    """A bar on terminals, lines elsewhere. Steps that take long are named on both."""

    def start(self) -> None:
        super().start()
        self._stopped = threading.Event()
        # Time of the last change of each task, and the changes that a terminal has been told of.
        self._changes: dict[TaskID, tuple[float, float]] = {}
        self._told: set[tuple[TaskID, float]] = set()
        self._lines = threading.Thread(target=self._write_lines, daemon=True)
        self._lines.start()

    def stop(self) -> None:
        self._stopped.set()
        if self._lines.is_alive():
            self._lines.join()
        super().stop()

    def _write_lines(self) -> None:
        while not self._stopped.wait(_LINE_SECONDS):
            for task in self.tasks:
                if not task.finished and task.visible:
                    self._write_line(task)

    def _write_line(self, task: Task) -> None:
        waited = self._waited(task)
        if self.console.is_terminal:
            change = (task.id, task.completed)
            if waited is None or change in self._told:
                return
            self._told.add(change)
        note = f" {task.fields['note']}" if task.fields.get("note") else ""
        if task.total is None:
            progress = f"{note}, for {waited or 0:.0f} s"
        else:
            step = f", at step {task.completed + 1:.0f} for {waited:.0f} s" if waited is not None else ""
            progress = f" {task.completed:.0f}/{task.total:.0f}{note}{step}, {_minutes(task.elapsed or 0)}"
        self.console.print(task.description + progress, soft_wrap=True, highlight=False)

    def _waited(self, task: Task) -> float | None:
        """Seconds for which a task has not gone on, None if it has since the last line."""
        now = monotonic()
        begun = now if task.completed else now - (task.elapsed or 0)
        completed, since = self._changes.get(task.id, (task.completed, begun))
        if completed != task.completed:
            since = now
        self._changes[task.id] = (task.completed, since)
        return now - since if now - since >= _LINE_SECONDS else None


@contextmanager
def waiting(say: Callable[[str], None], text: Callable[[float], str | None]) -> Iterator[None]:
    """Say every ten seconds, while a block runs, what it waits for.

    ``text`` gets the seconds since the block began, in another thread. It returns a line, or None for nothing to say.
    """
    began, ended = monotonic(), threading.Event()

    def write() -> None:
        while not ended.wait(_LINE_SECONDS):
            line = text(monotonic() - began)
            if line is not None:
                say(line)

    thread = threading.Thread(target=write, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _minutes(seconds: float) -> str:
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"


def markdown(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Lines of a Markdown table."""
    return [f"| {' | '.join(columns)} |", "|" + "---|" * len(columns), *(f"| {' | '.join(row)} |" for row in rows)]

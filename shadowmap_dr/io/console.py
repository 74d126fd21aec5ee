"""Tables and progress displays for the terminal, and tables in Markdown."""

from __future__ import annotations

import threading
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import Literal

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.measure import Measurement
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
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

    Without a terminal (in a pipe, in a file) it writes a line every ten seconds.
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


class _ProgressOrLines(Progress):
    """A bar on terminals, lines elsewhere."""

    def start(self) -> None:
        super().start()
        self._stopped = threading.Event()
        self._lines = threading.Thread(target=self._write_lines, daemon=True)
        if not self.console.is_terminal:
            self._lines.start()

    def stop(self) -> None:
        self._stopped.set()
        if self._lines.is_alive():
            self._lines.join()
        super().stop()

    def _write_lines(self) -> None:
        while not self._stopped.wait(_LINE_SECONDS):
            for task in self.tasks:
                if not task.finished:
                    total = "" if task.total is None else f"/{task.total:.0f}"
                    seconds = int(task.elapsed or 0)
                    note = f" {task.fields['note']}" if task.fields.get("note") else ""
                    time = f"{seconds // 60}:{seconds % 60:02d}"
                    self.console.print(f"{task.description} {task.completed:.0f}{total}{note}, {time}", soft_wrap=True)


def markdown(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Lines of a Markdown table."""
    return [f"| {' | '.join(columns)} |", "|" + "---|" * len(columns), *(f"| {' | '.join(row)} |" for row in rows)]

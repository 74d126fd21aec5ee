"""Tables and progress displays for the terminal, and tables in Markdown."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Sequence

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

# Seconds between lines of progress where there is no terminal to draw a bar on.
_LINE_SECONDS = 10.0


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """A table for the terminal: the first column left-aligned, all others right-aligned."""
    result = Table(title=title, title_justify="left", box=SIMPLE_HEAD)  # narrow enough for 80 columns
    for i, column in enumerate(columns):
        result.add_column(column, justify="left" if i == 0 else "right")
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

"""Progress of a run's steps, and an estimate of its seconds from the first ones."""

from __future__ import annotations

import time
from collections.abc import Callable

from rich.progress import Progress, TaskID

# Steps that are timed for the estimate, after the first one, which compiles kernels; least seconds that are worth a line.
_TIMED, _LONG = 3, 10.0


class RunSteps:
    """Shows the steps of a run. The first one, and runs that take long, get a line.

    Args:
        task: of the run, in ``progress``.
        title: of the run, at the beginning of lines.
        total: number of steps of a descent.
        say: prints a line.
    """

    def __init__(self, progress: Progress, task: TaskID, title: str, total: int, say: Callable[[str], None]) -> None:
        self._progress, self._task, self._title, self._total, self._say = progress, task, title, total, say
        self._began = time.monotonic()
        # Step and time of the first call: a resumed run does not begin with its first step.
        self._first: tuple[int, float] | None = None

    def __call__(self, finished: int, done: int) -> None:
        """Take note of ``done`` steps of the descent after ``finished`` ones."""
        self._progress.update(self._task, completed=done, note=f"try {finished + 1}" if finished else "")
        now = time.monotonic()
        if self._first is None:
            self._first = done, now
            if now - self._began >= 1:
                self._say(f"{self._title}: first step done, with its kernels compiled, after {now - self._began:.1f} s")
        elif not finished and done == self._first[0] + _TIMED:
            each = (now - self._first[1]) / _TIMED
            left = each * (self._total - done)
            if left >= _LONG:
                self._say(
                    f"{self._title}: {each:.2f} s a step here, by the last {_TIMED}: about {left:.0f} s for the other "
                    f"{self._total - done}"
                )

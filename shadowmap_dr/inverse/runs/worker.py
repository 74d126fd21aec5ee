"""Worker of batches: a process that keeps what a problem has built for as long as batches of the same problem come."""

from __future__ import annotations

import hashlib
import json
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi

from ...io.records import plain
from ...jit.gc import gc_quiet
from .problems import Problem


@dataclass(frozen=True)
class Batch:
    """One batch: some runs of a problem in a Mitsuba variant."""

    problem: Problem
    runs: tuple[int, ...]
    variant: str

    @property
    def title(self) -> str:
        """For people."""
        return f"{self.problem.name} runs {self.runs[0]}-{self.runs[-1]}"

    @property
    def file(self) -> str:
        """Name of the result's file."""
        return f"{stem(self.problem, self.variant)}-{self.runs[0]:06d}-{self.runs[-1]:06d}.json"

    @property
    def checkpoint(self) -> str:
        """Name of its checkpoint's file. Batches of another size may have left gaps, and checkpoints hold for their runs only."""
        whole = len(self.runs) == self.runs[-1] - self.runs[0] + 1
        which = "" if whole else "-" + hashlib.sha256(repr(self.runs).encode()).hexdigest()[:8]
        return f"{Path(self.file).stem}.checkpoint{which}.npz"


def stem(problem: Problem, variant: str) -> str:
    """Beginning of the names of a problem's files: its name, and a digest of all that decides on its results."""
    content = json.dumps([plain(problem.settings()), variant], sort_keys=True)
    return f"{problem.name}-{hashlib.sha256(content.encode()).hexdigest()[:8]}"


class Worker:
    """Does units, one at a time, in this process.

    Args:
        threads: of Dr.Jit, 0 for as many as there are. With a single one, Mitsuba 3.9 waits forever when it reads or writes an
            EXR file: problems must not do that.
    """

    def __init__(self, threads: int = 0) -> None:
        self.threads = threads
        self._key, self._built = "", None
        self._lock = threading.Lock()

    def do(self, batch: Batch, folder: Path | None, on_step: Callable[[int], None] = lambda done: None) -> dict[str, Any]:
        """The content of the unit's result file: settings, variant, runs, records, seconds.

        ``folder``: for checkpoints; where it does not exist (workers on other machines), there are none. They stay: whoever has
        written the result deletes them.
        """
        with self._lock, gc_quiet():
            # Both belong to a thread, and workers may use another one each time.
            if mi.variant() != batch.variant:
                mi.set_variant(batch.variant)
            if self.threads and dr.thread_count() != self.threads:
                dr.set_thread_count(self.threads)
            key = stem(batch.problem, batch.variant)
            began = time.perf_counter()
            if key != self._key:
                self._key, self._built = "", None  # the old one's memory first
                self._key, self._built = key, batch.problem.build()
            built = time.perf_counter()
            checkpoint = None
            if folder is not None and folder.is_dir():
                checkpoint = folder / batch.checkpoint
            records = batch.problem.run_batch(self._built, batch.runs, checkpoint, on_step)
            ended = time.perf_counter()
        return plain(
            {
                "settings": batch.problem.settings(),
                "variant": batch.variant,
                "runs": batch.runs,
                "records": records,
                "seconds": {"build": built - began, "runs": ended - built},
                "threads": dr.thread_count(),
            }
        )

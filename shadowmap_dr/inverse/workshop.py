"""Where batches are done: a process that keeps what a problem has built for as long as batches of the same problem come."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi

from ..report import plain
from ..timing import quiet_garbage
from .problems import Problem


@dataclass(frozen=True)
class Unit:
    """One batch: some runs of a problem."""

    problem: Problem
    runs: tuple[int, ...]

    @property
    def title(self) -> str:
        """For people."""
        return f"{self.problem.name} runs {self.runs[0]}-{self.runs[-1]}"

    @property
    def file(self) -> str:
        """Name of the result's file."""
        return f"{self.problem.name}-{self.runs[0]:06d}-{self.runs[-1]:06d}.json"


class Workshop:
    """Does units, one at a time, in this process.

    Args:
        variant: Mitsuba variant.
        threads: of Dr.Jit, 0 for as many as there are. With a single one, Mitsuba 3.9 waits forever when it reads or writes an
            EXR file: problems must not do that.
    """

    def __init__(self, variant: str, threads: int = 0) -> None:
        self._variant, self._threads = variant, threads
        self._key, self._built = "", None
        self._lock = threading.Lock()

    def do(self, unit: Unit, folder: Path | None, on_step: Callable[[int], None] = lambda done: None) -> dict[str, Any]:
        """The content of the unit's result file: settings, runs, records, seconds.

        ``folder``: for checkpoints; where it does not exist (workers on other machines), there are none.
        """
        with self._lock, quiet_garbage():
            # Both belong to a thread, and workers may use another one each time.
            if mi.variant() != self._variant:
                mi.set_variant(self._variant)
            if self._threads and dr.thread_count() != self._threads:
                dr.set_thread_count(self._threads)
            settings = plain(unit.problem.settings())
            key = json.dumps([unit.problem.name, settings], sort_keys=True)
            began = time.perf_counter()
            if key != self._key:
                self._key, self._built = "", None  # the old one's memory first
                self._key, self._built = key, unit.problem.build()
            built = time.perf_counter()
            checkpoint = None
            if folder is not None and folder.is_dir():
                checkpoint = folder / f"{Path(unit.file).stem}.checkpoint.npz"
            records = unit.problem.run_batch(self._built, unit.runs, checkpoint, on_step)
            if checkpoint is not None:
                checkpoint.unlink(missing_ok=True)
            ended = time.perf_counter()
        return plain(
            {
                "settings": settings,
                "runs": unit.runs,
                "records": records,
                "seconds": {"build": built - began, "runs": ended - built},
                "threads": dr.thread_count(),
            }
        )

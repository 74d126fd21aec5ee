"""Worker of batches: keeps the built objects of a problem while batches of the same problem follow."""

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

from ...io.records import digest, plain
from ...jit.gc import gc_quiet
from ...jit.threads import second_thread
from .problems import Problem


@dataclass(frozen=True)
class Batch:
    """One batch: some runs of a problem in a Mitsuba variant."""

    problem: Problem
    runs: tuple[int, ...]
    variant: str

    @property
    def title(self) -> str:
        """Title for progress bars."""
        return f"{self.problem.name} runs {self.runs[0]}-{self.runs[-1]}"

    @property
    def file(self) -> str:
        """Name of the result file."""
        return f"{stem(self.problem, self.variant)}-{self.runs[0]:06d}-{self.runs[-1]:06d}.json"

    @property
    def checkpoint(self) -> str:
        """Name of the checkpoint file. It belongs to exactly these runs: if they have gaps, their hash is a part of it."""
        whole = len(self.runs) == self.runs[-1] - self.runs[0] + 1
        which = "" if whole else "-" + hashlib.sha256(repr(self.runs).encode()).hexdigest()[:8]
        return f"{Path(self.file).stem}.checkpoint{which}.npz"


def stem(problem: Problem, variant: str) -> str:
    """Beginning of the names of a problem's files: its name, and a hash of settings and variant."""
    content = json.dumps([plain(problem.settings()), variant], sort_keys=True)
    return f"{problem.name}-{hashlib.sha256(content.encode()).hexdigest()[:8]}"


class Worker:
    """Worker that does batches, one at a time, in this process.

    Args:
        threads: number of Dr.Jit threads, 0 for the default. With a single thread, Mitsuba 3.9 waits forever when it reads or
            writes an EXR file: problems must not do that.
    """

    def __init__(self, threads: int = 0) -> None:
        self.threads = threads
        self._key = ""
        self._built: Any = None  # Any: result of `Problem.build`
        self._lock = threading.Lock()

    def do(self, batch: Batch, folder: Path | None, on_step: Callable[[int], None] = lambda done: None) -> dict[str, Any]:
        """Do a batch. Returns the content of its result file: settings, variant, runs, records, seconds, threads.

        ``folder``: for checkpoints; without it (workers on other machines) there are none. The caller deletes them when the
        result is on disk.
        """
        with self._lock, gc_quiet():
            # Variant and thread count belong to a Python thread, and Dask may use another thread each time.
            if mi.variant() != batch.variant:
                mi.set_variant(batch.variant)
            if self.threads and dr.thread_count() != self.threads:
                dr.set_thread_count(self.threads)
            key = stem(batch.problem, batch.variant)
            began = time.perf_counter()
            if key != self._key:
                self._key, self._built = "", None  # frees the memory of the old problem first
                with second_thread():
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
                "check": digest([batch.runs, records]),
                "seconds": {"build": built - began, "runs": ended - built},
                "threads": dr.thread_count(),
            }
        )

"""Problems for sweeps that cost nothing. A module of its own, since workers in other processes import it."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from fakes import POINTS, BlobRenderer

from shadowmap_dr.inverse import LossProblem, MethodProblem, PoseFit


@dataclass(frozen=True)
class Bowls(LossProblem):
    """Run r looks for the point (r, -r / 2), where its paraboloid is lowest.

    ``log``: folder in which each batch leaves a file when it begins. ``fatal``: the process that first comes to this run kills
    itself. ``fails``: this run raises an error. ``stops``: so does the first batch after so many steps,
    once. ``size``: of batches.
    """

    runs: int
    name: str = "bowls"
    steps: int = 40
    size: int = 2
    log: str = ""
    fatal: int = -1
    fails: int = -1
    stops: int = -1
    pause: float = 0.0
    step_size: float = 0.5

    def settings(self) -> dict[str, Any]:
        return {"kind": "bowls", "steps": self.steps, "step_size": self.step_size}

    def batch_size(self, memory: int) -> int:
        return self.size

    def build(self) -> Any:
        return mi.Float(1, -0.5)

    def start(self, run: int) -> np.ndarray:
        return np.random.default_rng(run).uniform(-1, 1, 2)

    def run_batch(self, built: Any, runs: Any, checkpoint: Path | None, on_step: Any) -> list[dict[str, Any]]:
        if self.log:
            Path(self.log, f"{runs[0]}-{runs[-1]}-{time.monotonic_ns()}").write_text(str(os.getpid()))

        def stop(done: int) -> None:
            on_step(done)
            time.sleep(self.pause)
            if done == self.stops and first_time(self.log, "stopped"):
                raise RuntimeError("stopped")

        if self.fatal in runs and first_time(self.log, "died"):
            os.kill(os.getpid(), signal.SIGKILL)
        if self.fails in runs:
            raise ValueError(f"run {self.fails} fails")
        records = super().run_batch(built, runs, checkpoint, stop)
        threads = {"threads": dr.thread_count(), "variant": mi.variant()}
        return [{**record, **threads} for record in records]

    def losses(self, built: Any, parameters: Any, runs: Any) -> Any:
        index, total = dr.arange(mi.UInt32, len(runs)), mi.Float(0)
        for k in range(2):
            total += dr.square(dr.gather(mi.Float, parameters, 2 * index + k) - mi.Float(list(runs)) * built[k])
        return total


def first_time(folder: str, name: str) -> bool:
    """True if nobody has asked for this name before, in any process."""
    try:
        Path(folder, name).touch(exist_ok=False)
    except FileExistsError:
        return False
    return True


@dataclass(frozen=True)
class BlobPoses(MethodProblem):
    """Pose estimation with a stand-in for the renderer."""

    runs: int
    name: str = "poses"
    steps: int = 30

    def build(self) -> PoseFit:
        renderer = BlobRenderer.create(12, len(POINTS))
        blank = np.zeros((12, 12, 1), np.float32)
        reference = PoseFit(renderer, "object", POINTS, blank).render(np.zeros(3))
        return PoseFit(renderer, "object", POINTS, reference, step_size=0.02)

    def start(self, run: int) -> np.ndarray:
        return np.random.default_rng(run).uniform(-0.1, 0.1, 3)

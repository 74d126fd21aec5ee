"""Cases with known outcomes, for the test of the runner itself. They belong to no run."""

from __future__ import annotations

import os
import signal
import time
import warnings
from pathlib import Path

import numpy as np

from shadowmap_dr.errors import ShadowmapError

from .outcome import Refused, check
from .values import pick

BEHAVIOURS = ("result", "refusal", "long refusal", "error", "wrong", "warning", "signal", "exit", "hang", "memory")


def behaviour(rng: np.random.Generator) -> str:
    """The behaviour of a case."""
    return pick(rng, BEHAVIOURS)


def run(rng: np.random.Generator, folder: Path) -> str:
    """Behave as the case does."""
    chosen = behaviour(rng)
    if chosen == "refusal":
        raise ShadowmapError("a bad value: give another.")
    if chosen == "long refusal":
        raise Refused("a bad value:\ngive another.")  # as a command writes it; ShadowmapError has one line
    if chosen == "error":
        return str(vars()["none"])
    if chosen == "signal":
        os.kill(os.getpid(), signal.SIGSEGV)
    if chosen == "exit":
        os._exit(3)
    if chosen == "hang":
        time.sleep(60)
    if chosen == "memory":
        check(len(b"x" * 500_000_000) > 0, "nothing")
    if chosen == "warning":
        import shadowmap_dr

        warnings.warn_explicit("overflow", RuntimeWarning, str(shadowmap_dr.__file__), 1)
    check(chosen != "wrong", "two is three")
    return "as it should be"

"""Timing that can be trusted on a shared machine: contenders take turns, and what else ran there is written down."""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ... import __version__, _llvm
from ...jit.gc import gc_quiet

#: Calls before the measured ones, which compile kernels and fill caches.
WARM_UP = 5


@dataclass(frozen=True)
class Contender:
    """Something to be timed.

    Attributes:
        call: one unit of work; the device is waited for afterwards, inside the measured time.
        rounds: how many measured calls at most.
        warm_up: calls before the first measured one.
        settle: unmeasured calls whenever its turn comes, since the others have filled the caches of the processor meanwhile.
        burst: measured calls each turn.
        seconds: measured calls (and warm-up) end when they have used up this time, but one call is always measured. If
            already the first warm-up call takes longer, that one counts.
    """

    call: Callable[[], Any]
    rounds: int = 20
    warm_up: int = WARM_UP
    settle: int = 1
    burst: int = 5
    seconds: float = 60.0


def timed(call: Callable[[], Any]) -> float:
    """Seconds that one call takes, the work of the device included."""
    began = time.perf_counter()
    result = call()  # kept until the end: freeing a result is not a part of the work
    dr.sync_thread()
    seconds = time.perf_counter() - began
    del result
    return seconds


def alternate(
    contenders: Mapping[str, Contender], on_call: Callable[[int, int, str], None] = lambda done, total, name: None
) -> dict[str, list[float]]:
    """Times several contenders in turns, so that a change of the machine's load meets all of them.

    Args:
        contenders: by name.
        on_call: told after each call how many are done of how many at most, and whose turn it is.

    Returns:
        Seconds of each measured call.
    """
    samples: dict[str, list[float]] = {name: [] for name in contenders}
    spent = dict.fromkeys(contenders, 0.0)
    total = sum(c.rounds + c.warm_up for c in contenders.values())
    done = 0

    def note(name: str) -> None:
        nonlocal done
        done = min(done + 1, total)
        on_call(done, total, name)

    with gc_quiet():
        for name, contender in contenders.items():
            for _ in range(contender.warm_up):
                seconds = timed(contender.call)
                spent[name] += seconds
                note(name)
                if spent[name] > contender.seconds:
                    samples[name].append(seconds)
                    break
        waiting = [name for name in contenders if not samples[name]]
        while waiting:
            for name in list(waiting):
                contender = contenders[name]
                for _ in range(contender.settle if len(contenders) > 1 else 0):
                    spent[name] += timed(contender.call)
                for _ in range(contender.burst):
                    samples[name].append(timed(contender.call))
                    spent[name] += samples[name][-1]
                    note(name)
                    if len(samples[name]) >= contender.rounds or spent[name] > contender.seconds:
                        waiting.remove(name)
                        break
    on_call(total, total, "")
    return samples


def summary(seconds: Sequence[float]) -> dict[str, Any]:
    """Median, quartiles, least and number of the measured times (seconds)."""
    q1, median, q3 = np.quantile(seconds, (0.25, 0.5, 0.75))
    return {"median": float(median), "q1": float(q1), "q3": float(q3), "min": float(min(seconds)), "count": len(seconds)}


def compare(samples: Mapping[str, Sequence[float]], ratios: Sequence[tuple[str, str]] = ()) -> dict[str, Any]:
    """Summaries of all contenders, and ratios of medians for pairs (numerator, denominator) that are both there."""
    times = {name: summary(values) for name, values in samples.items() if len(values)}
    pairs = {f"{a} / {b}": times[a]["median"] / times[b]["median"] for a, b in ratios if a in times and b in times}
    return {"seconds": times, "ratio_of_medians": pairs}


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float | None:
    """Slope of log(cost) over log(size) by least squares: 1 is linear growth. None for less than two different sizes."""
    if len(set(sizes)) < 2:
        return None
    return float(np.polyfit(np.log(np.asarray(sizes, float)), np.log(np.asarray(costs, float)), 1)[0])


def load() -> list[float] | None:
    """Load averages over 1, 5 and 15 minutes, None where the system does not tell."""
    return list(os.getloadavg()) if hasattr(os, "getloadavg") else None


class OtherWork:
    """Cores that other processes keep busy. A load average cannot tell them from this one."""

    def __init__(self) -> None:
        self._began = self._now()

    def cores(self) -> float | None:
        """Cores that processes other than this one and its children have used on average since the start of this record.

        None where the system does not tell (Linux does).
        """
        before, now = self._began, self._now()
        if before is None or now is None or now[0] <= before[0]:
            return None
        return max(0.0, ((now[1] - before[1]) - (now[2] - before[2])) / (now[0] - before[0]))

    @staticmethod
    def _now() -> tuple[float, float, float] | None:
        """Seconds: of the clock, of all processors' work, of the work of this process and its finished children."""
        try:
            ticks = [int(text) for text in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:8]]
            busy = (sum(ticks) - ticks[3] - ticks[4]) / os.sysconf("SC_CLK_TCK")  # all but idle and waiting for disks
        except (OSError, ValueError, IndexError):
            return None
        own = os.times()
        return time.perf_counter(), busy, own.user + own.system + own.children_user + own.children_system


def peak_memory() -> int:
    """Most memory (bytes) that this process has occupied so far."""
    try:
        # Not `ru_maxrss`, which a process inherits from the one that started it.
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return 1024 * int(line.split()[1])
    except OSError:
        pass
    import resource  # not on Windows

    unit = 1 if sys.platform == "darwin" else 1024
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def forget_peak_memory() -> None:
    """Lets `peak_memory` count from what is occupied now, where the system can do that (Linux)."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        pass


def machine() -> dict[str, Any]:
    """Conditions of a measurement: processor, threads, versions, variant."""
    llvm = _llvm.loaded_version()
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "threads": dr.thread_count(),
        "gpu": f"CUDA {dr.detail.cuda_version()}" if dr.has_backend(dr.JitBackend.CUDA) else None,
        "system": platform.platform(),
        "variant": mi.variant(),
        "shadowmap_dr": __version__,
        "mitsuba": mi.__version__,
        "drjit": dr.__version__,
        "llvm": ".".join(map(str, llvm)) if llvm else None,
        "python": platform.python_version(),
        "numpy": np.__version__,
    }


def _processor() -> str:
    try:
        entries = [line.split(":", 1) for line in Path("/proc/cpuinfo").read_text().splitlines() if ":" in line]
    except OSError:
        return platform.processor() or platform.machine()
    found = {name.strip(): value.strip() for name, value in entries}
    vector = next((kind for kind in ("avx512f", "avx2") if kind in found.get("flags", "").split()), "")
    numbers = [f"family {found['cpu family']} model {found['model']}"] if "cpu family" in found and "model" in found else []
    return ", ".join(filter(None, [found.get("model name", platform.machine()), *numbers, vector]))

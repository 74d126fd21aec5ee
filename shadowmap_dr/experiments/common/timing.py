"""Timing on a shared machine: contenders take turns, and the load by other processes is recorded."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from ...io.machine import machine as machine  # with the times
from ...jit.gc import gc_quiet

#: Calls before the measured ones, which compile kernels and fill caches.
WARM_UP = 5


@dataclass(frozen=True)
class Contender:
    """A call to be timed.

    Attributes:
        call: one unit of work. The measured time includes waiting for the device.
        rounds: largest number of measured calls.
        warm_up: calls before the first measured one.
        settle: unmeasured calls at the start of each turn, since the other contenders have overwritten the processor's caches.
        burst: measured calls in each turn.
        seconds: time limit of warm-up and measured calls together; at least one call is measured. If the warm-up exceeds
            the limit, its last call counts as measured.
    """

    call: Callable[[], object]
    rounds: int = 20
    warm_up: int = WARM_UP
    settle: int = 1
    burst: int = 5
    seconds: float = 60.0


def timed(call: Callable[[], object]) -> float:
    """Seconds that one call takes, the work of the device included."""
    began = time.perf_counter()
    result = call()  # kept until the end: freeing the result is not part of the work
    dr.sync_thread()
    seconds = time.perf_counter() - began
    del result
    return seconds


def alternate(
    contenders: Mapping[str, Contender], on_call: Callable[[int, int, str], None] = lambda done, total, name: None
) -> dict[str, list[float]]:
    """Time several contenders in turns, so that a change of the machine's load affects all of them.

    Args:
        contenders: by name.
        on_call: called after each call with the number of finished calls, the largest total, and the contender's name.

    Returns:
        Seconds of each measured call, by contender.
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
    """Median, quartiles and minimum of the measured times (seconds), and their number."""
    q1, median, q3 = np.quantile(seconds, (0.25, 0.5, 0.75))
    return {"median": float(median), "q1": float(q1), "q3": float(q3), "min": float(min(seconds)), "count": len(seconds)}


def compare(samples: Mapping[str, Sequence[float]], ratios: Sequence[tuple[str, str]] = ()) -> dict[str, Any]:
    """Summaries of all contenders, and ratios of medians for the pairs (numerator, denominator) that were both measured."""
    times = {name: summary(values) for name, values in samples.items() if len(values)}
    pairs = {f"{a} / {b}": times[a]["median"] / times[b]["median"] for a, b in ratios if a in times and b in times}
    return {"seconds": times, "ratio_of_medians": pairs}


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float | None:
    """Slope of log(cost) over log(size) by least squares: 1 is linear growth. None for fewer than two different sizes."""
    if len(set(sizes)) < 2:
        return None
    return float(np.polyfit(np.log(np.asarray(sizes, float)), np.log(np.asarray(costs, float)), 1)[0])


def load() -> list[float] | None:
    """Load averages over 1, 5 and 15 minutes, None on systems without them."""
    return list(os.getloadavg()) if hasattr(os, "getloadavg") else None


class OtherWork:
    """Measurement of the cores that other processes keep busy. A load average includes this process."""

    def __init__(self) -> None:
        self._began = self._now()

    def cores(self) -> float | None:
        """Average number of cores used by processes other than this one and its children since the object was made.

        None on systems without `/proc/stat` (Linux has it).
        """
        before, now = self._began, self._now()
        if before is None or now is None or now[0] <= before[0]:
            return None
        return max(0.0, ((now[1] - before[1]) - (now[2] - before[2])) / (now[0] - before[0]))

    @staticmethod
    def _now() -> tuple[float, float, float] | None:
        """Seconds: of the clock, of work on all processors, of work by this process and its finished children."""
        try:
            ticks = [int(text) for text in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:8]]
            busy = (sum(ticks) - ticks[3] - ticks[4]) / os.sysconf("SC_CLK_TCK")  # all but idle and waiting for disks
        except (OSError, ValueError, IndexError):
            return None
        own = os.times()
        return time.perf_counter(), busy, own.user + own.system + own.children_user + own.children_system


def peak_memory() -> int:
    """Peak resident memory (bytes) of this process so far."""
    try:
        # Not `ru_maxrss`, which a process inherits from its parent.
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return 1024 * int(line.split()[1])
    except OSError:
        pass
    import resource  # not on Windows

    unit = 1 if sys.platform == "darwin" else 1024
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def forget_peak_memory() -> None:
    """Reset `peak_memory` to the memory in use now, on systems that can (Linux)."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        pass

"""Time of an optimisation step with all threads and with one, again and again: does the machine always run at one speed?

python docs/examples/step_phases.py [--resolution 128 512 1024] [--seconds 30]
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import numpy as np

from shadowmap_dr.experiments.common.timing import timed
from shadowmap_dr.experiments.pose.methods import build_method
from shadowmap_dr.experiments.pose.scene import make_problem, start_pose

# isort: split
import drjit as dr  # after shadowmap_dr, which chooses the LLVM library
import mitsuba as mi

parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("--resolution", type=int, nargs="+", default=[128, 512, 1024])
parser.add_argument("--seconds", type=float, default=30)
options = parser.parse_args()

mi.set_variant("llvm_ad_rgb")
threads = dr.thread_count()
methods = []
with tempfile.TemporaryDirectory() as folder:
    for size in options.resolution:
        problem = make_problem("spot", size, work=Path(folder))
        methods.append(build_method("shadows", problem, np.zeros((size, size, 3), np.float32)))
    for method in methods:
        method.reset(start_pose(0, 0))
        for _ in range(6):
            method.step()


def milliseconds(step: Callable[[], float]) -> float:
    """Median over a quarter of a second, or over five steps."""
    times: list[float] = []
    while len(times) < 5 or sum(times) < 0.25:
        times.append(timed(step))
    return 1e3 * median(times)


begun = time.perf_counter()
while time.perf_counter() < begun + options.seconds:
    line = []
    for count in dict.fromkeys((threads, 1)):
        dr.set_thread_count(count)
        methods[0].step()  # threads begin
        line.append(f"{count} threads: " + " ".join(f"{milliseconds(method.step):.2f}" for method in methods))
    print(f"{time.perf_counter() - begun:.0f} s, ms a step, " + "; ".join(line), flush=True)

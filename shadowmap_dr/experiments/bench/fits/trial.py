"""Runs of the command on chosen problems, for its developers: a line for each start, and the summary.

``python -m shadowmap_dr.experiments.bench.fits.trial OUT [--calibration] [--only NAME]... [--starts N]`` leaves scenes,
photographs and results in OUT, and writes OUT/runs.json. Settings are tuned with ``--calibration``, never on problems that are
scored.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi

from ....io import records
from . import catalogue, section
from .score import summary


def line(run: Mapping[str, Any]) -> str:
    """A run in one line: what was found, in units of the bars."""
    head = f"{run['problem']} {run['start']}: {run['seconds']:.1f} s, "
    if "failed" in run:
        return f"{head}failed: {run['failed']}"
    told = f"{'found' if run['found'] else 'not found'} ({100 * run['unexplained']:.1f} % unexplained)"
    errors = ", ".join(f"{one['name']} {one['what']} {one['error']:.3g} / {one['bar']:g}" for one in run["deviations"])
    return f"{head}{'solved' if run['solved'] else 'NOT SOLVED'}, called {told}; {errors}"


def main() -> None:
    parser = argparse.ArgumentParser(description="Run shadowmap-dr fit on problems of its benchmark.")
    parser.add_argument("out", type=Path)
    parser.add_argument("--calibration", action="store_true", help="the problems for tuning instead of those that are scored")
    parser.add_argument("--only", action="append", default=[], help="name of a problem")
    parser.add_argument("--starts", type=int, default=1, help="number of starts of each problem")
    arguments = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    every = catalogue.calibration() if arguments.calibration else catalogue.scored()
    runs = []
    for problem in catalogue.named(arguments.only) if arguments.only else every:
        for number in range(arguments.starts):
            runs.append(section.run(problem, number, arguments.out))
            print(line(runs[-1]), flush=True)
            records.write_json(arguments.out / "runs.json", records.plain({"runs": runs, "summary": summary(runs)}))
    print(", ".join(f"{name} {value}" for name, value in summary(runs).items()))


if __name__ == "__main__":
    main()

"""Benchmark: problems for `shadowmap-dr fit`, each from several starts, with the whole command in a process of its own."""

from __future__ import annotations

import functools
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ....errors import ShadowmapError
from ....io import records
from ...common.timing import summary
from ..common import BenchOptions, Unit, Update
from . import catalogue
from .problem import FitProblem
from .score import score
from .targets import write_problem

#: After this time a run is ended, and counts as not solved.
_SECONDS = 900.0
#: The command, as its console script runs it.
COMMAND = (sys.executable, "-c", "from shadowmap_dr.cli.main import main; main()", "fit")


def units(options: BenchOptions) -> list[Unit]:
    """A unit for each problem."""
    names = options.what.fits
    problems = list(catalogue.scored()) if names is None else catalogue.named(names)
    if options.meshes is not None:
        problems += catalogue.of_meshes(options.meshes)
    return [Unit(problem.name, functools.partial(measure, options, problem)) for problem in problems]


def measure(options: BenchOptions, problem: FitProblem, done: Mapping[str, Any], update: Update) -> dict[str, Any]:
    """Results of the command from all starts. Fails if it ends with an error from each."""
    work = options.work / "fits"
    runs = []
    for number in range(options.what.fit_starts):
        update(number, options.what.fit_starts, "")
        runs.append(run(problem, number, work))
    failed = [one["failed"] for one in runs if "failed" in one]
    result = {
        "vary": [one.name for one in problem.varied],
        "integrator": problem.integrator,
        "common factor": list(problem.common_factor),
        "starts": runs,
        "seconds": {"fit": summary([one["seconds"] for one in runs])},
    }
    return {**result, "failed": failed[0]} if len(failed) == len(runs) else result


def run(problem: FitProblem, number: int, work: Path) -> dict[str, Any]:
    """Result of the command from one start: its score and ``seconds`` of wall-clock time, or ``failed``, a message."""
    folder = work / problem.name / f"start-{number}"
    shutil.rmtree(folder, ignore_errors=True)
    write_problem(problem, number, folder / "given", work / "pictures")
    command = [*COMMAND, *problem.options(), "--out", str(folder / "out")]
    began = time.perf_counter()
    failure = _failure(command, folder / "given")
    result: dict[str, Any] = {"problem": problem.name, "start": number, "seconds": time.perf_counter() - began}
    try:
        if failure is None:
            record = records.read_json(folder / "out" / "fit.json")
            return result | score(problem, problem.start(number), record, folder / "out")
    except (ShadowmapError, RuntimeError, KeyError, TypeError, ValueError, OSError) as error:
        failure = f"its result cannot be read: {type(error).__name__}: {' '.join(str(error).split())}"
    return {**result, "failed": failure, "solved": False}


def _failure(command: list[str], folder: Path) -> str | None:
    """Run a command in a folder. Returns its message if it fails."""
    package = str(Path(__file__).resolve().parents[4])
    paths = filter(None, (package, os.environ.get("PYTHONPATH")))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, env=environment, timeout=_SECONDS, check=False)
    except subprocess.TimeoutExpired:
        return f"ended after {_SECONDS:.0f} s"
    if done.returncode == 0:
        return None
    lines = done.stderr.decode(errors="replace").strip().splitlines()
    return f"status {done.returncode}: {lines[-1] if lines else 'no message'}"

"""Sweeps: all runs of some problems, in batches. Each batch writes its own file, so that killed sweeps can resume."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi
from rich.console import Console

from ...errors import ShadowmapError, warn
from ...io import console as io_console
from ...io import records
from ...io.files import make_folder
from .problems import Problem
from .schedulers import check_scheduler, check_threads, do_batches
from .worker import Batch, stem

#: Default limit of a batch's memory, in bytes.
MEMORY = 1 << 31
#: Ends of the names of checkpoints, of batches, of single runs of a batch, and of further descents of a run.
_CHECKPOINT = r"\.checkpoint(-[0-9a-f]{8})?(-run\d+)?(-try\d+)?\.npz"


def run_sweep(
    problems: Sequence[Problem],
    out: Path,
    *,
    scheduler: str = "local",
    variant: str = "llvm_ad_rgb",
    threads: int = 0,
    memory: int = MEMORY,
    resume: bool = False,
    console: Console | None = None,
) -> dict[str, list[dict[str, Any]]]:
    """Do all runs of some problems.

    Each batch leaves a file ``out/batches/NAME-DIGEST-FIRST-LAST.json`` with the records of its runs, which appears when it is
    complete. DIGEST is a hash of settings and variant: files of the same problem with other settings stay.

    Args:
        problems: must have different names.
        out: folder for results.
        scheduler: ``local`` (this process), ``processes:N`` (on this machine) or the address of a Dask scheduler
            (``tcp://host:port``). Scheduler and workers must have this package, and the module of the problems, installed.
        variant: Mitsuba variant, here and in workers.
        threads: Dr.Jit threads of each process, 0 for one for each core.
        memory: approximate limit of a batch's memory, in bytes.
        resume: keep records on disk with the settings of their problem; batches of another size or another scheduler may have
            written them. Otherwise the files of these problems with these settings are deleted first.

    Returns:
        Records by the name of the problem, in the order of the runs.

    Raises:
        ShadowmapError: names are equal or no file names; the scheduler is unknown; a batch failed (the results of the others are
            on disk by then).
    """
    check_scheduler(scheduler)
    check_threads(threads)
    if variant not in mi.variants():
        raise ShadowmapError(f"no Mitsuba variant {variant!r}: choose one of {', '.join(mi.variants())}.")
    names = [problem.name for problem in problems]
    if len(set(names)) != len(names):
        raise ShadowmapError(f"two problems of the sweep have the same name in {', '.join(names)}: rename one.")
    for name in names:
        if not re.fullmatch(r"[\w.-]+", name):
            raise ShadowmapError(f"a problem is called {name!r}: use letters, digits, '.', '_' and '-'.")
    folder = out / "batches"
    done = {problem.name: stored_records(problem, out, variant) if resume else {} for problem in problems}
    if not resume:
        for problem in problems:
            for path in [*_files(problem, folder, variant), *_files(problem, folder, variant, _CHECKPOINT)]:
                path.unlink()
    batches = [batch for problem in problems for batch in _batches(problem, variant, done[problem.name], memory)]
    make_folder(folder)
    with io_console.progress(console or io_console.notes()) as progress:
        total = progress.add_task("batches", total=len(batches), note="")
        task = progress.add_task("", total=None, note="", visible=False)

        def on_step(batch: Batch, steps: int) -> None:
            progress.update(task, description=batch.title, total=batch.problem.steps, completed=steps, visible=True)

        def on_done(batch: Batch, result: dict[str, Any]) -> None:
            records.write_json(folder / batch.file, result)
            for path in folder.glob(f"{Path(batch.file).stem}.checkpoint*"):
                path.unlink(missing_ok=True)
            done[batch.problem.name] |= dict(zip(result["runs"], result["records"], strict=True))
            progress.update(total, advance=1)

        def say(line: str) -> None:
            progress.console.print(line, soft_wrap=True, highlight=False)

        do_batches(batches, scheduler, threads=threads, folder=folder.resolve(), on_done=on_done, on_step=on_step, say=say)
    for problem in problems:  # checkpoints of killed batches of another size
        for path in _files(problem, folder, variant, _CHECKPOINT):
            path.unlink(missing_ok=True)
    return {problem.name: [done[problem.name][run] for run in problem.run_numbers()] for problem in problems}


def _batches(problem: Problem, variant: str, done: dict[int, Any], memory: int) -> list[Batch]:
    """Batches of the remaining runs, of nearly equal size."""
    left = [run for run in problem.run_numbers() if run not in done]
    if not left:
        return []
    count = -(-len(left) // max(1, problem.batch_size(memory)))
    ends = [len(left) * k // count for k in range(count + 1)]
    return [Batch(problem, tuple(left[a:b]), variant) for a, b in zip(ends[:-1], ends[1:], strict=True)]


def _files(problem: Problem, folder: Path, variant: str, ending: str = r"\.json") -> list[Path]:
    """Files of a problem's batches, without those of problems whose names begin with its name."""
    pattern = re.compile(re.escape(stem(problem, variant)) + r"-\d+-\d+" + ending)
    return [path for path in sorted(folder.glob("*")) if pattern.fullmatch(path.name)]


def stored_records(problem: Problem, out: Path, variant: str) -> dict[int, Any]:
    """Records by run, from complete batches below ``out`` with the problem's settings and this variant."""
    wanted = records.plain(problem.settings())
    found: dict[int, Any] = {}
    for path in _files(problem, out / "batches", variant):
        try:
            result = records.read_json(path)
            if result["check"] != records.digest([result["runs"], result["records"]]):
                raise ValueError("edited")
            if not all(isinstance(run, int) for run in result["runs"]):
                raise ValueError("no runs")
            if result["settings"] == wanted and result["variant"] == variant:
                pairs = zip(result["runs"], result["records"], strict=True)
                found |= {run: record for run, record in pairs if run in problem.run_numbers()}
        except (ShadowmapError, KeyError, TypeError, ValueError):
            warn(f"{path} was edited or is damaged: its runs are made again.")
    return found

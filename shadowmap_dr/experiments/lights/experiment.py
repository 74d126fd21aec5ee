"""Light estimation: find the directions of n lights from images of an object and its shadow, in thousands of runs.

Protocol: an object on a floor, seen from above, under n directional lights of known, equal irradiance. Targets and starts are
drawn from a cone about the vertical. They depend on the number of the run only, and are the same for all settings and objects.
Adam on unit vectors, mean squared error. Estimated and true directions are matched greedily; their mean dot product is the
alignment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from ...errors import ShadowmapError, warn
from ...inverse import run_sweep
from ...inverse.runs.schedulers import check_threads
from ...inverse.runs.sweep import MEMORY, stored_records
from ...io import assets, files
from ...io import records as io_records
from ...io.machine import header
from ...io.options import option
from ...io.ranges import RUNS, check_ranges
from ..common.options import scheduler_option, threads_option
from .problem import LightProblem, LightSetting, check_problem, curve_iterations
from .report import pictures, plot
from .scene import OBJECTS

# Fields that say how runs are made, not which.
_HOW = ("memory", "scheduler", "threads", "out", "resume")


def _mebibytes(count: int) -> int:
    return count << 20


@dataclass(frozen=True)
class LightOptions(LightSetting):
    """Options of the experiment: every object with every number of lights and filter size.

    A filter size of 0 is for no shadows. The limit of ``memory`` is in bytes. For ``scheduler``, ``threads``, ``memory`` and
    ``resume`` see :func:`shadowmap_dr.inverse.run_sweep`.
    """

    objects: tuple[str, ...] = option(
        OBJECTS, names=("--object",), choices=OBJECTS, shown="all", help="Object, by name or mesh file; repeatable."
    )
    lights: tuple[int, ...] = option((1,), full=(1, 2, 3, 4, 5), allowed=(1, 5), help="Lights, 1 to 5; repeatable.")
    filter_sizes: tuple[int, ...] = option(
        (3, 0),
        full=(1, 3, 5, 9, 15, 0),
        names=("--filter-size",),
        shown="3",
        allowed=(0, 255),
        help="Texels of the filter, 1 for none; repeatable.",
    )
    runs: int = option(16, full=150, allowed=RUNS, help="Runs of each object and setting.")
    memory: int = option(
        MEMORY,
        shown=f"{MEMORY >> 20}",
        parse=_mebibytes,
        allowed=(1, 1 << 50),
        help="Approximate memory limit of a batch of runs, in MiB.",
    )
    scheduler: str = scheduler_option()
    threads: int = threads_option()
    out: Path = option(Path("lights"), help="Folder for the results.")
    resume: bool = option(False, help="Keep complete batches, and summaries of other settings.")

    def __post_init__(self) -> None:
        check_ranges(self)
        for name, values in (("object", self.objects), ("number of lights", self.lights), ("filter size", self.filter_sizes)):
            if not values:
                raise ShadowmapError(f"no {name} given: name at least one.")
            if len(set(values)) != len(values):
                raise ShadowmapError(f"one {name} is given twice in {', '.join(map(str, values))}: name each once.")
        check_threads(self.threads)
        for problem in self.problems():
            check_problem(problem)

    @property
    def settings(self) -> dict[str, Any]:
        """Settings that the results depend on."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _HOW}

    def problems(self) -> list[LightProblem]:
        """A problem for each object of each setting."""
        common = {f.name: getattr(self, f.name) for f in fields(LightSetting)}
        # Workers may have another working directory.
        known = assets.mesh_names()
        objects = [str(Path(name).resolve()) if name not in known and Path(name).is_file() else name for name in self.objects]
        return [
            LightProblem(name, lights, self.runs, filter_size=size, **common)
            for lights in self.lights
            for size in self.filter_sizes
            for name in objects
        ]


def run_lights(options: LightOptions, *, variant: str = "llvm_ad_rgb", console: Console | None = None) -> list[dict[str, Any]]:
    """Run the experiment and write its results below `options.out`.

    Files: `lights.json` (one summary for each setting), `lights.png` (alignment over iterations and over filter sizes),
    `pictures.png` (the first run of each object), and a file for each batch in `batches`. If `options.resume` is set,
    `lights.json` keeps the summaries of other settings, and summaries of the same settings still count the objects and runs of
    earlier calls whose batches are in the folder. Returns the summaries.
    """
    path = files.check_output(options.out / "lights.json", (".json",))
    problems = options.problems()
    stored = _stored(path) if options.resume else []
    found = run_sweep(
        problems,
        options.out,
        scheduler=options.scheduler,
        variant=variant,
        threads=options.threads,
        memory=options.memory,
        resume=options.resume,
        console=console,
    )
    groups: dict[str, list[LightProblem]] = {}
    for problem in problems:
        groups.setdefault(problem.setting, []).append(problem)
    summaries = []
    for setting, group in groups.items():
        earlier = next((entry for entry in stored if entry["setting"] == setting), None)
        wider = _widened(group, earlier, options.out, variant) if earlier else None
        summaries.append(summary(*(wider or (group, [found[problem.name] for problem in group]))))
    new = [entry["setting"] for entry in summaries]
    summaries = [entry for entry in stored if entry["setting"] not in new] + summaries
    io_records.write_json(path, {**header(options.settings), "summaries": summaries})
    plot(options.out / "lights.png", summaries)
    shown = next(iter(groups.values()))
    pictures(options.out / "pictures.png", shown, [found[problem.name] for problem in shown])
    return summaries


def summary(problems: Sequence[LightProblem], records: Sequence[Sequence[dict[str, Any]]]) -> dict[str, Any]:
    """Statistics over all objects and runs of one setting, as JSON values."""
    final = np.array([[record["alignment"] for record in own] for own in records])
    curves = np.array([record["alignment_curve"] for own in records for record in own])
    settings = {"filter": "gaussian", **problems[0].settings()}
    settings = {key: value for key, value in settings.items() if key not in ("object", "object_digest", "steps")}
    return io_records.plain(
        {
            "setting": problems[0].setting,
            **settings,
            "shadows": problems[0].shadows,
            "objects": [problem.object for problem in problems],
            "runs": problems[0].runs,
            "alignment_mean": final.mean(),
            "alignment_std": final.std(),
            "alignment_median": np.median(final),
            "alignment_least": final.min(),
            "share_from_0.995": (final >= 0.995).mean(),
            "alignment_by_object": {p.object: row.mean() for p, row in zip(problems, final, strict=True)},
            "curve_iterations": curve_iterations(problems[0].iterations),
            "curve_mean": curves.mean(0),
            "curve_std": curves.std(0),
        }
    )


def _stored(path: Path) -> list[dict[str, Any]]:
    if not path.exists():
        return []
    try:
        value = io_records.read_json(path)
    except ShadowmapError:
        value = None
    summaries = value.get("summaries") if isinstance(value, dict) else None
    needed = {"setting", "lights", "filter", "filter_size", "cone_deg", "strategy", "starts", "reference", "objects", "runs"}
    needed |= {"alignment_mean", "alignment_std", "alignment_least", "share_from_0.995"}
    needed |= {"curve_iterations", "curve_mean", "curve_std"}
    if not isinstance(summaries, list):
        io_records.set_aside(path)
        return []
    kept = [entry for entry in summaries if isinstance(entry, dict) and needed <= entry.keys() and _is_sound(entry)]
    if len(kept) < len(summaries):
        warn(f"{path}: {len(summaries) - len(kept)} of {len(summaries)} summaries were edited or are damaged: they are left out.")
    return kept


def _is_sound(entry: dict[str, Any]) -> bool:
    """True if what the next call reads of a summary has the right types."""
    curves = [entry[f"curve_{name}"] for name in ("iterations", "mean", "std")]
    numbers = [entry[name] for name in ("lights", "filter_size", "runs", "cone_deg", "starts", "alignment_mean", "alignment_std")]
    return (
        isinstance(entry["setting"], str)
        and isinstance(entry["objects"], list)
        and all(isinstance(name, str) for name in entry["objects"])
        and all(isinstance(curve, list) and len(curve) == len(curves[0]) for curve in curves)
        and all(isinstance(number, int | float) for curve in (numbers, *curves) for number in curve)
    )


def _widened(
    group: Sequence[LightProblem], earlier: dict[str, Any], out: Path, variant: str
) -> tuple[list[LightProblem], list[list[dict[str, Any]]]] | None:
    """Problems and records of an earlier summary and this call together, None if the folder lacks some of them."""
    runs = max(group[0].runs, earlier["runs"])
    objects = list(dict.fromkeys([*earlier["objects"], *(problem.object for problem in group)]))
    problems = [replace(group[0], object=name, runs=runs) for name in objects]
    try:
        found = [stored_records(problem, out, variant) for problem in problems]
    except ShadowmapError:
        return None  # a mesh file has been removed
    if any(len(own) < runs for own in found):
        return None
    return problems, [[own[run] for run in range(runs)] for own in found]

"""The benchmark behind `shadowmap-dr bench`: steps, rasterization, growth of costs, and time by pass.

A section is measured in units. Each unit is stored in the JSON file when it is complete: a killed run loses only the unit in
progress, and `resume` continues after the last complete one.
"""

from __future__ import annotations

import shlex
import sys
import time
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
from rich.console import Console
from rich.progress import TaskID

from ... import __version__
from ...errors import ShadowmapError
from ...io import console as io_console
from ...io import files, records
from ...io.machine import DRJIT_VERSION, header, machine
from ..common.timing import OtherWork, load
from . import breakdown as bench_breakdown
from . import first as bench_first
from . import loops as bench_loops
from . import plugin as bench_plugin
from . import raster as bench_raster
from . import report as bench_report
from . import scaling as bench_scaling
from . import steps as bench_steps
from . import sums as bench_sums
from . import torch_steps as bench_torch
from .common import BenchOptions, Unit
from .fits import section as bench_fits

FORMAT = "shadowmap-dr bench 1"

UNITS: dict[str, Callable[[BenchOptions], list[Unit]]] = {
    "steps": bench_steps.units,
    "raster": bench_raster.units,
    "scaling": bench_scaling.units,
    "breakdown": bench_breakdown.units,
    "sums": bench_sums.units,
    "loops": bench_loops.units,
    "first": bench_first.units,
    "plug-in": bench_plugin.units,
    "torch": bench_torch.units,
    "fits": bench_fits.units,
}


def run_bench(options: BenchOptions, *, console: Console | None = None) -> dict[str, Any]:
    """Measure the sections and write `options.out` and a plot beside it (`.png`).

    A unit that fails is stored with the entry `failed`; the others are still measured.

    Returns:
        Content of the JSON file: `sections` (by name, each with `command`, `settings`, `machine` and `units`),
        `machine`, `load_before` and `load_after`, `figures`, the rows of the table, and `checks`, digests of the sections.
    """
    console = console or io_console.notes()
    files.check_output(options.out, (".json",))
    record = _stored(options)
    command = shlex.join(["shadowmap-dr", *sys.argv[1:]])
    settings = _settings(options)
    record |= {"format": FORMAT, **header(settings), "load_before": load()}
    plan = {name: UNITS[name](options) for name in UNITS if name in options.only}
    for name in plan:
        section = record["sections"].get(name, {})
        keep = options.resume and section.get("settings") == settings
        kept = {key: value for key, value in section.get("units", {}).items() if "failed" not in value} if keep else {}
        record["sections"][name] = {"command": command, "settings": settings, "machine": machine(), "units": kept}
    _write(options, record)

    with io_console.progress(console) as progress:
        for name, units in plan.items():
            task = progress.add_task(name, total=len(units), note="")
            done = record["sections"][name]["units"]
            for number, unit in enumerate(units):
                progress.update(task, completed=number)
                if unit.name in done:
                    continue
                inner = progress.add_task(f"{name} {unit.name}", total=None, note="")

                def update(count: int, total: int, note: str, inner: TaskID = inner) -> None:
                    progress.update(inner, completed=count, total=total, note=note)

                done[unit.name] = _measured(unit, done, update)
                progress.remove_task(inner)
                _write(options, record)
                line = f"{name} {unit.name}: {bench_report.outcome(done[unit.name])}"
                progress.console.print(line, highlight=False, markup=False, soft_wrap=True)
                # Memory that a unit leaves allocated would count as memory of the next.
                dr.flush_malloc_cache()
            progress.remove_task(task)
    record["load_after"] = load()
    record["figures"] = [row.plain() for row in bench_report.rows(record)]
    _write(options, record)
    bench_report.plot(options.out.with_suffix(".png"), record)
    return record


def failures(record: dict[str, Any], sections: tuple[str, ...]) -> list[str]:
    """Units that could not be measured, a line for each."""
    return [
        f"{name} {key}: {unit['failed']}"
        for name in sections
        for key, unit in record["sections"][name]["units"].items()
        if "failed" in unit
    ]


def _measured(unit: Unit, done: dict[str, Any], update: Callable[[int, int, str], None]) -> dict[str, Any]:
    before, began, others = load(), time.perf_counter(), OtherWork()
    try:
        result = unit.run(done, update)
    except (RuntimeError, ShadowmapError, MemoryError) as error:
        text = " ".join(str(error).split()) or type(error).__name__
        result = {"failed": text}
    surroundings = {
        "load_before": before,
        "load_after": load(),
        "cores_used_by_others": others.cores(),
        "wall_seconds": time.perf_counter() - began,
    }
    return records.plain({**result, **surroundings})


def _settings(options: BenchOptions) -> dict[str, Any]:
    """Settings with which results must have been measured to be kept."""
    return records.plain(
        {
            "quick": options.quick,
            "mitsuba_seconds": options.mitsuba_seconds,
            "meshes": options.meshes,
            "sizes": vars(options.what),
            "variant": mi.variant(),
            "threads": dr.thread_count(),
            "shadowmap_dr": __version__,
            "mitsuba": mi.__version__,
            "drjit": DRJIT_VERSION,
        }
    )


def _stored(options: BenchOptions) -> dict[str, Any]:
    """The record in the file, or an empty one."""
    if not options.out.exists():
        return {"sections": {}}
    try:
        record = records.read_json(options.out)
    except ShadowmapError:
        record = None
    if not isinstance(record, dict) or record.get("format") != FORMAT or not isinstance(record.get("sections"), dict):
        if not options.resume:
            raise ShadowmapError(f"{options.out} is no record of a benchmark, or is damaged: choose another file.")
        records.set_aside(options.out)
        return {"sections": {}}
    checks = record.get("checks")
    own = checks.get("sections") if isinstance(checks, dict) else None
    own = own if isinstance(own, dict) else {}
    sound = {
        name: section
        for name, section in record["sections"].items()
        if (own.get(name) == records.digest(section) if checks is not None else _is_sound(name, section))
    }
    if len(sound) < len(record["sections"]):
        records.set_aside(options.out)
    return {**record, "sections": sound}


def _is_sound(name: str, section: Any) -> bool:  # Any: JSON
    """True if reports can be made of a section."""
    units = section.get("units") if isinstance(section, dict) else None
    if not isinstance(units, dict) or not all(isinstance(unit, dict) for unit in units.values()):
        return False
    try:
        rows = [row.cells() for row in bench_report.rows({"sections": {name: section}})]
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, ZeroDivisionError):
        return False
    return all(isinstance(cell, str) for cells in rows for cell in cells)


def _write(options: BenchOptions, record: dict[str, Any]) -> None:
    record["checks"] = {"sections": {name: records.digest(section) for name, section in record["sections"].items()}}
    records.write_json(options.out, record)

"""The command `shadowmap-dr bench`: times and memory, beside Mitsuba and Embree."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from ..errors import ShadowmapError
from ..experiments.bench import common as bench_common
from ..experiments.bench import experiment as bench_experiment
from ..experiments.bench import report as bench_report
from ..variants import COLOURED, DEFAULT_VARIANT, set_variant
from .options import Variant


def bench(
    quick: Annotated[bool, typer.Option("--quick", help="Small sizes and few steps: minutes instead of hours.")] = False,
    out: Annotated[Path, typer.Option(help="JSON file to write; a plot is written beside it.")] = Path("bench.json"),
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="|".join(bench_common.SECTIONS), help="Section to measure; repeatable [default: all]."),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Keep the measurements of a killed run with the same options.")
    ] = False,
    mitsuba_seconds: Annotated[
        float,
        typer.Option(help="Time limit of each part that runs Mitsuba's integrator; the record names parts that it cut off."),
    ] = 900.0,
    variant: Variant = DEFAULT_VARIANT,
) -> None:
    """Measure times of steps and rasterization, growth of costs, and profiles, beside Mitsuba and Embree.

    Writes a JSON file, a plot, and a folder of meshes and reference images. The file keeps sections that are not measured.
    """
    options = bench_common.BenchOptions(
        quick=quick,
        out=out,
        only=tuple(dict.fromkeys(only or bench_common.SECTIONS)),
        resume=resume,
        mitsuba_seconds=mitsuba_seconds,
    )
    set_variant(variant, COLOURED)
    record = bench_experiment.run_bench(options)
    Console().print(bench_report.table(record))
    typer.echo(f"Record: {out}, plot: {out.with_suffix('.png')}")
    failed = bench_experiment.failures(record, options.only)
    if failed:
        raise ShadowmapError(f"{len(failed)} part(s) could not be measured; the first: {failed[0]}")

"""The command `shadowmap-dr lights`: directions of lights from images, thousands of runs."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from ..errors import ShadowmapError
from ..experiments.lights import experiment as lights_experiment
from ..experiments.lights import report as lights_report
from ..experiments.lights import speed as lights_speed
from ..experiments.lights.problem import LightProblem, check_problem
from ..inverse.runs.schedulers import check_scheduler
from ..io import console, files, records
from ..io.machine import header
from ..io.ranges import FILTER_SIDE, check_range
from ..variants import DEFAULT_VARIANT, set_variant
from .options import After, Given, Variant, from_record


@from_record(first=("objects", "lights", "runs", "filter", "filter_sizes"), full="1 to 5 lights, all filters, 150 runs: hours.")
def lights(
    given: Given[lights_experiment.LightOptions],
    shadows: Annotated[
        bool | None,
        typer.Option("--shadows/--no-shadows", help="Only with shadows, or only without.  [default: both]"),
        After("filter_sizes"),
    ] = None,
    variant: Variant = DEFAULT_VARIANT,
) -> None:
    """Find the directions of lights by comparing images, many runs at once.

    Writes OUT/lights.json, a plot of alignments (lights.png), pictures of some runs, and a file for each batch.
    """
    options = given.make(filter_sizes=_filter_sizes(given, shadows))
    set_variant(variant)
    summaries = lights_experiment.run_lights(options, variant=variant)
    console.show(lights_report.table(summaries))
    console.result(options.out / "lights.png", options.out / "lights.json")


def _filter_sizes(given: Given[lights_experiment.LightOptions], shadows: bool | None) -> tuple[int, ...]:
    """Filter sizes, and 0 for runs without shadows, as far as these are asked for."""
    sizes = given["filter_sizes"]
    if "filter_sizes" in given:
        for size in sizes:
            check_range("--filter-size", size, FILTER_SIDE)
        if shadows is False:
            raise ShadowmapError("--filter-size and --no-shadows: leave one of the two out.")
        return sizes if shadows else (*sizes, 0)
    if shadows is None:
        return sizes
    return tuple(size for size in sizes if size) if shadows else (0,)


@from_record()
def lights_times(options: lights_speed.TimesOptions, variant: Variant = DEFAULT_VARIANT) -> None:
    """Measure the time of a step of light estimation for a run, in batches and alone, and the gain by more workers.

    Writes OUT/times.json. Nothing else should run on the machine.
    """
    sizes = tuple(dict.fromkeys(options.batches))
    problem = LightProblem(options.object, options.lights, max(sizes))
    check_problem(problem)
    path = files.check_output(options.out / "times.json", (".json",))
    if options.workers:
        check_scheduler("processes:1")
    set_variant(variant)
    steps = lights_speed.measure(problem, sizes)
    times, ratios = steps["seconds"], steps["ratio_of_medians"]
    rows = [
        [name, f"{1e3 * entry['median']:.2f}", f"{ratios.get(f'{name} / batch of {max(sizes)}', 1):.2f}"]
        for name, entry in times.items()
    ]
    console.show(console.table("A step of a run", ["way", "ms", "/ largest batch"], rows))
    settings = {"object": options.object, "lights": options.lights, "batches": sizes}
    record: dict[str, Any] = {**header(settings), "steps": steps}
    records.write_json(path, record)
    if options.workers:
        problem = LightProblem(options.object, options.lights, 32, iterations=60)
        record["workers"] = lights_speed.measure_workers(problem, (1, 2), options.out)
        speed_up = record["workers"]["speed_up"]["2"]
        records.write_json(path, record)
        typer.echo(f"Two workers with a thread each do {speed_up:.2f} times the work of one.")
    console.result(record=path)

"""The command `shadowmap-dr lights`: directions of lights from images, thousands of runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, cast

import typer
from rich.console import Console

from ..errors import ShadowmapError
from ..experiments.common.ranges import FILTER_SIDE, check_range
from ..experiments.lights import experiment as lights_experiment
from ..experiments.lights import report as lights_report
from ..experiments.lights import speed as lights_speed
from ..experiments.lights.problem import LightProblem, ReferenceKind, StrategyKind, check_problem
from ..experiments.lights.scene import OBJECTS
from ..inverse.runs.schedulers import check_scheduler
from ..io import console, files, records
from ..variants import DEFAULT_VARIANT, set_variant
from .options import Scheduler, SchedulerThreads, Variant, given

_FULL_LIGHTS, _FULL_SIZES, _FULL_RUNS = (1, 2, 3, 4, 5), (1, 3, 5, 9, 15, 0), 150


def lights(
    object: Annotated[
        list[str] | None, typer.Option(metavar="|".join(OBJECTS), help="Object, by name or mesh file; repeatable [default: all].")
    ] = None,
    count: Annotated[list[int] | None, typer.Option("--lights", help="Lights, 1 to 5; repeatable [default: 1].")] = None,
    runs: Annotated[int | None, typer.Option(help="Runs of each object and setting [default: 16].")] = None,
    filter: Annotated[str, typer.Option(metavar="gaussian|box|wendland", help="Filter of the shadow maps.")] = "gaussian",
    filter_size: Annotated[
        list[int] | None, typer.Option("--filter-size", help="Texels of the filter, 1 for none; repeatable [default: 3].")
    ] = None,
    shadows: Annotated[
        bool | None, typer.Option("--shadows/--no-shadows", help="Only with shadows, or only without [default: both].")
    ] = None,
    map_resolution: Annotated[int, typer.Option(help="Texels along each side of a shadow map.")] = 256,
    resolution: Annotated[int, typer.Option(help="Image width and height in pixels.")] = 128,
    iterations: Annotated[int, typer.Option(help="Steps of the optimiser.")] = 200,
    strategy: Annotated[
        str, typer.Option(metavar="plain|coarse", help="coarse: larger steps and a larger filter in the first half.")
    ] = "plain",
    starts: Annotated[int, typer.Option(help="Starts of each run; the start with the least final loss counts.")] = 1,
    reference: Annotated[str, typer.Option(metavar="own|mitsuba", help="Renderer of the targets.")] = "own",
    spp: Annotated[int, typer.Option(help="Samples per pixel of path-traced targets.")] = 512,
    cone: Annotated[float, typer.Option(help="Opening angle in degrees of the cone that directions are drawn from.")] = 60,
    seed: Annotated[int, typer.Option(help="Seed of targets and starts.")] = 0,
    memory: Annotated[int, typer.Option(help="Approximate memory limit of a batch of runs, in MiB.")] = 2048,
    scheduler: Scheduler = "local",
    threads: SchedulerThreads = 0,
    full: Annotated[bool, typer.Option("--full", help="1 to 5 lights, all filters, 150 runs: hours.")] = False,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("lights"),
    resume: Annotated[bool, typer.Option("--resume", help="Keep complete batches, and summaries of other settings.")] = False,
    variant: Variant = DEFAULT_VARIANT,
) -> None:
    """Find the directions of lights by comparing images, many runs at once.

    Writes OUT/lights.json, a plot of alignments (lights.png), pictures of some runs, and a file for each batch.
    """
    check_range("--memory", memory, (1, 1 << 30))
    for size in filter_size or ():
        check_range("--filter-size", size, FILTER_SIDE)
    if filter_size and shadows is False:
        raise ShadowmapError("--filter-size and --no-shadows: leave one of the two out.")
    defaults = lights_experiment.LightOptions()
    sizes = tuple(filter_size or (_FULL_SIZES if full else defaults.filter_sizes))
    sizes = tuple(size for size in sizes if size or shadows is not True) if shadows is not False else (0,)
    if filter_size and shadows is None:
        sizes = (*sizes, 0)
    # `LightOptions` checks the choices.
    options = lights_experiment.LightOptions(
        objects=tuple(object or defaults.objects),
        lights=tuple(count or (_FULL_LIGHTS if full else defaults.lights)),
        filter_sizes=sizes,
        runs=given(runs, _FULL_RUNS if full else defaults.runs),
        filter=filter,
        map_resolution=map_resolution,
        resolution=resolution,
        iterations=iterations,
        strategy=cast(StrategyKind, strategy),
        starts=starts,
        reference=cast(ReferenceKind, reference),
        spp=spp,
        seed=seed,
        cone_deg=cone,
        out=out,
        resume=resume,
        scheduler=scheduler,
        threads=threads,
        memory=memory << 20,
    )
    set_variant(variant)
    summaries = lights_experiment.run_lights(options, variant=variant)
    Console().print(lights_report.table(summaries))
    typer.echo(f"Record, plot and pictures: {out}")


def lights_times(
    object: Annotated[str, typer.Option(metavar="|".join(OBJECTS), help="Object, by name or mesh file.")] = "bunny",
    count: Annotated[int, typer.Option("--lights", help="Lights, 1 to 5.")] = 1,
    batch: Annotated[list[int] | None, typer.Option(help="Runs of a batch; repeatable [default: 1, 16, 150].")] = None,
    workers: Annotated[bool, typer.Option(help="Also compare one Dask worker with two.")] = True,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("lights-times"),
    variant: Variant = DEFAULT_VARIANT,
) -> None:
    """Measure the time of a step of light estimation for a run, in batches and alone, and the gain by more workers.

    Writes OUT/times.json. Nothing else should run on the machine.
    """
    sizes = tuple(dict.fromkeys(batch or (1, 16, 150)))
    for size in sizes:
        check_range("--batch", size, (1, 100_000))
    problem = LightProblem(object, count, max(sizes))
    check_problem(problem)
    path = files.check_output(out / "times.json", (".json",))
    if workers:
        check_scheduler("processes:1")
    set_variant(variant)
    steps = lights_speed.measure(problem, sizes)
    times, ratios = steps["seconds"], steps["ratio_of_medians"]
    rows = [
        [name, f"{1e3 * entry['median']:.2f}", f"{ratios.get(f'{name} / batch of {max(sizes)}', 1):.2f}"]
        for name, entry in times.items()
    ]
    Console().print(console.table("A step of a run", ["way", "ms", "/ largest batch"], rows))
    record: dict[str, Any] = {"steps": steps}
    records.write_json(path, record)
    if workers:
        record["workers"] = lights_speed.measure_workers(LightProblem(object, count, 32, iterations=60), (1, 2), out)
        speed_up = record["workers"]["speed_up"]["2"]
        records.write_json(path, record)
        typer.echo(f"Two workers with a thread each do {speed_up:.2f} times the work of one.")

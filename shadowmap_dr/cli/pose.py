"""The command `shadowmap-dr pose`: poses from images, with three methods side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from ..experiments.pose import experiment as pose_experiment
from ..experiments.pose.methods import usual_methods
from ..variants import DEFAULT_VARIANT, set_variant
from .options import Scheduler, SchedulerThreads, Variant


def pose(
    object_: Annotated[
        list[str] | None, typer.Option("--object", metavar="NAME|FILE", help="Mesh of this package, .ply or .obj; repeatable.")
    ] = None,
    resolution: Annotated[list[int] | None, typer.Option(help="Image width and height in pixels; repeatable.")] = None,
    method: Annotated[
        list[str] | None,
        typer.Option(
            metavar="|".join(pose_experiment.METHODS),
            help="Method; repeatable [default: all; the first two with --shadow-only or --normals vertex].",
        ),
    ] = None,
    runs: Annotated[int, typer.Option(help="Runs with different starts.")] = 1,
    seed: Annotated[int, typer.Option(help="Run r starts from the random numbers of seed + r.")] = 0,
    iterations: Annotated[int, typer.Option(help="Steps of the optimiser.")] = 150,
    reference: Annotated[
        str, typer.Option(metavar="mitsuba|own", help="Reference image: path-traced, or made with this library.")
    ] = "mitsuba",
    shadow_only: Annotated[bool, typer.Option("--shadow-only", help="The camera sees the shadow but not the object.")] = False,
    normals: Annotated[
        str, typer.Option(metavar="face|vertex", help="Shade the object flat, with the normals of its faces, or smoothly.")
    ] = "face",
    samples: Annotated[int, typer.Option(help="Samples per pixel of our own methods.")] = 1,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("pose"),
    resume: Annotated[bool, typer.Option("--resume", help="Keep finished runs, go on with killed ones.")] = False,
    scheduler: Scheduler = "local",
    threads: SchedulerThreads = 0,
    variant: Variant = DEFAULT_VARIANT,
) -> None:
    """Find an object's pose from an image of it and its shadow, with three methods side by side.

    Spot at 128 x 128 pixels unless told otherwise. Writes OUT/pose.json, images and a convergence plot.
    """
    set_variant(variant)
    options = pose_experiment.PoseOptions(
        objects=tuple(object_ or ["spot"]),
        resolutions=tuple(resolution or [128]),
        methods=tuple(method or usual_methods(shadow_only, normals)),
        runs=runs,
        seed=seed,
        iterations=iterations,
        reference=reference,
        shadow_only=shadow_only,
        normals=normals,
        samples=samples,
        out=out,
        resume=resume,
        scheduler=scheduler,
        threads=threads,
    )
    records = pose_experiment.run_pose(options)
    Console().print(pose_experiment.table(records))
    typer.echo(f"Records, images and plots: {out}")

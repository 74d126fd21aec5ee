"""The command `shadowmap-dr pose`: poses from images, with three methods side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, cast

import typer
from rich.console import Console

from ..experiments.pose import experiment as pose_experiment
from ..experiments.pose.methods import usual_methods
from ..experiments.pose.scene import NormalKind, ReferenceKind
from ..variants import DEFAULT_VARIANT, set_variant
from .options import Scheduler, SchedulerThreads, Variant


def pose(
    object_: Annotated[
        list[str] | None, typer.Option("--object", metavar="NAME|FILE", help="Mesh of this package, or a mesh file; repeatable.")
    ] = None,
    resolution: Annotated[list[int] | None, typer.Option(help="Image width and height in pixels; repeatable.")] = None,
    method: Annotated[
        list[str] | None,
        typer.Option(
            metavar="|".join(pose_experiment.METHODS),
            help="Method; repeatable [default: all; the first two with --shadow-only or --normals vertex].",
        ),
    ] = None,
    runs: Annotated[int, typer.Option(help="Number of runs, each with its own start.")] = 1,
    seed: Annotated[int, typer.Option(help="Seed of the starts: run r uses seed + r.")] = 0,
    iterations: Annotated[int, typer.Option(help="Steps of the optimiser.")] = 150,
    reference: Annotated[
        str, typer.Option(metavar="mitsuba|own", help="Reference image: path-traced, or rendered by this library.")
    ] = "mitsuba",
    shadow_only: Annotated[bool, typer.Option("--shadow-only", help="The camera sees the shadow but not the object.")] = False,
    normals: Annotated[str, typer.Option(metavar="face|vertex", help="Shading of the object: flat, or smooth.")] = "face",
    samples: Annotated[int, typer.Option(help="Samples per pixel of our own methods.")] = 1,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("pose"),
    resume: Annotated[bool, typer.Option("--resume", help="Keep finished runs, resume killed ones.")] = False,
    scheduler: Scheduler = "local",
    threads: SchedulerThreads = 0,
    variant: Variant = DEFAULT_VARIANT,
) -> None:
    """Find an object's pose from an image of the object and its shadow, with three methods side by side.

    Default: Spot at 128 x 128 pixels. Writes OUT/pose.json, images and a convergence plot.
    """
    set_variant(variant)
    # `PoseOptions` checks the choices.
    options = pose_experiment.PoseOptions(
        objects=tuple(object_ or ["spot"]),
        resolutions=tuple(resolution or [128]),
        methods=tuple(method or usual_methods(shadow_only, normals)),
        runs=runs,
        seed=seed,
        iterations=iterations,
        reference=cast(ReferenceKind, reference),
        shadow_only=shadow_only,
        normals=cast(NormalKind, normals),
        samples=samples,
        out=out,
        resume=resume,
        scheduler=scheduler,
        threads=threads,
    )
    records = pose_experiment.run_pose(options)
    Console().print(pose_experiment.table(records))
    typer.echo(f"Records, images and plots: {out}")

"""The command `shadowmap-dr art`: objects whose shadows are pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from ..experiments.art import experiment as art_experiment
from ..variants import COLOURED, DEFAULT_VARIANT, set_variant
from .options import Variant


def art(
    target: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME|IMAGE", help="Image (PNG, JPEG, SVG, ...) of a shadow; twice for two views."),
    ] = None,
    text: Annotated[list[str] | None, typer.Option(metavar="LETTERS", help="Letters instead of an image; repeatable.")] = None,
    mesh: Annotated[
        str | None, typer.Option(metavar="NAME|FILE", help="What is deformed [default: a sphere of 12,800 triangles].")
    ] = None,
    collection: Annotated[
        str | None, typer.Option(metavar="NAME|FILE", help="Copies of this mesh cast the shadow: moved, turned and scaled.")
    ] = None,
    copies: Annotated[int, typer.Option(metavar="N", help="Copies at most; their number doubles every 150 steps.")] = 128,
    receiver: Annotated[str, typer.Option(metavar="plane|wavy", help="What the shadow falls on.")] = "plane",
    camera: Annotated[
        str, typer.Option(metavar="orthographic|perspective", help="Seen straight on, or in perspective from the side.")
    ] = "orthographic",
    iterations: Annotated[
        int | None, typer.Option(help="Steps of the optimiser [default: 400, and 1100 of a collection].")
    ] = None,
    smoothness: Annotated[float, typer.Option(help="How stiff the mesh is; finer meshes need more.")] = 20.0,
    remesh: Annotated[
        int | None, typer.Option(metavar="STEPS", help="Mesh the surface anew after so many steps, again and again.")
    ] = None,
    fill_holes: Annotated[bool, typer.Option("--fill-holes", help="Fill enclosed holes of the targets.")] = False,
    resolution: Annotated[int, typer.Option(help="Pixels along each side of the shadow images.")] = 256,
    map_resolution: Annotated[
        int | None, typer.Option(help="Texels along each side of the shadow maps [default: as many as pixels].")
    ] = None,
    animate: Annotated[str, typer.Option(metavar="webp|gif|none", help="Kind of the animated pictures.")] = "webp",
    printable: Annotated[bool, typer.Option("--printable", help="Write an STL file, too, and report on the mesh.")] = False,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("art"),
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a killed run of the same settings.")] = False,
    variant: Variant = DEFAULT_VARIANT,
) -> None:
    """Deform an object until its shadow is a given picture, or its two shadows two pictures.

    Or move, turn and scale copies of one (--collection), which start as one and double every 150 steps.

    Writes meshes (PLY, OBJ, GLB), images of shadows and errors, animated pictures, and OUT/art.json.
    """
    options = art_experiment.ArtOptions(
        targets=(*(target or ()), *(f"text:{letters}" for letters in text or ())),
        mesh=mesh,
        collection=collection,
        most=copies,
        receiver=receiver,
        camera=camera,
        smoothness=smoothness,
        remesh=remesh,
        fill_holes=fill_holes,
        resolution=resolution,
        map_resolution=map_resolution,
        iterations=iterations,
        animate=None if animate == "none" else f".{animate}",
        printable=printable,
        out=out,
        resume=resume,
    )
    set_variant(variant, COLOURED)
    record = art_experiment.run_art(options)
    Console().print(art_experiment.table(record))
    typer.echo(art_experiment.summary(record))
    typer.echo(f"Meshes, pictures and record: {out}")

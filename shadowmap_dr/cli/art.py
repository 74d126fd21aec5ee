"""The command `shadowmap-dr art`: objects whose shadows match pictures."""

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
        str | None, typer.Option(metavar="NAME|FILE", help="Mesh to deform [default: a sphere of 12,800 triangles].")
    ] = None,
    collection: Annotated[
        str | None, typer.Option(metavar="NAME|FILE", help="Mesh whose moved, turned and scaled copies cast the shadow.")
    ] = None,
    copies: Annotated[int, typer.Option(metavar="N", help="Largest number of copies; it doubles every 150 steps.")] = 128,
    receiver: Annotated[str, typer.Option(metavar="plane|wavy", help="Receiver of the shadow.")] = "plane",
    camera: Annotated[
        str, typer.Option(metavar="orthographic|perspective", help="Frontal view, or perspective from the side.")
    ] = "orthographic",
    iterations: Annotated[int | None, typer.Option(help="Steps of the optimiser [default: 400; 1100 for a collection].")] = None,
    smoothness: Annotated[float, typer.Option(help="Stiffness of the mesh; finer meshes need more.")] = 20.0,
    remesh: Annotated[int | None, typer.Option(metavar="STEPS", help="Remesh the surface every so many steps.")] = None,
    fill_holes: Annotated[bool, typer.Option("--fill-holes", help="Fill enclosed holes of the targets.")] = False,
    resolution: Annotated[int, typer.Option(help="Pixels along each side of the shadow images.")] = 256,
    map_resolution: Annotated[
        int | None, typer.Option(help="Texels along each side of the shadow maps [default: the resolution].")
    ] = None,
    animate: Annotated[str, typer.Option(metavar="webp|gif|none", help="Kind of the animated pictures.")] = "webp",
    printable: Annotated[bool, typer.Option("--printable", help="Also write an STL file, and report on the mesh.")] = False,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("art"),
    resume: Annotated[bool, typer.Option("--resume", help="Resume a killed run with the same settings.")] = False,
    variant: Variant = DEFAULT_VARIANT,
) -> None:
    """Deform an object until its shadow is a given picture, or its two shadows two pictures.

    With --collection, move, turn and scale copies of a mesh instead: one copy at first, twice as many every 150 steps.

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
    for message in record["warnings"]:
        typer.echo(f"warning: {message}", err=True)
    typer.echo(f"Meshes, pictures and record: {out}")

"""The command `shadowmap-dr maps`: all shadow maps on scenes that are hard for them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from ..experiments.maps import experiment as maps_experiment
from ..experiments.maps import scenes as maps_scenes
from ..variants import COLOURED, DEFAULT_VARIANT, set_variant
from .options import Variant


def maps(
    scene: Annotated[
        list[str] | None, typer.Option(metavar="|".join(maps_scenes.SCENES), help="Scene; repeatable [default: all].")
    ] = None,
    method: Annotated[
        list[str] | None,
        typer.Option(metavar="|".join(maps_experiment.CANDIDATES), help="Shadow map; repeatable [default: all]."),
    ] = None,
    resolution: Annotated[int, typer.Option(help="Image width and height in pixels.")] = 512,
    map_resolution: Annotated[int, typer.Option(help="Texels along each side of a shadow map.")] = 256,
    filter_size: Annotated[int, typer.Option(help="Texels along each side of the filter.")] = 3,
    spp: Annotated[int, typer.Option(help="Samples per pixel of the path-traced images.")] = 1024,
    pose_runs: Annotated[int, typer.Option(help="Poses to find with each shadow map, from shadows alone.")] = 10,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("maps"),
    variant: Variant = DEFAULT_VARIANT,
) -> None:
    """Compare all shadow maps on scenes that are hard for them, against path tracing.

    Writes OUT/maps.json and a sheet of pictures, OUT/maps.png.
    """
    options = maps_experiment.MapsOptions(
        scenes=tuple(scene or maps_scenes.SCENES),
        candidates=tuple(method or maps_experiment.CANDIDATES),
        resolution=resolution,
        map_resolution=map_resolution,
        filter_size=filter_size,
        reference_spp=spp,
        pose_runs=pose_runs,
        out=out,
    )
    set_variant(variant, COLOURED)
    Console().print(maps_experiment.table(maps_experiment.run_maps(options)))
    typer.echo(f"Record and pictures: {out}")

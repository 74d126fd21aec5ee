"""The command `shadowmap-dr soft`: extended lights against path tracing."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from ..errors import ShadowmapError
from ..experiments.soft import experiment as soft_experiment
from ..experiments.soft import report as soft_report
from ..experiments.soft import scenes as soft_scenes
from ..variants import COLOURED, DEFAULT_VARIANT, set_variant
from .options import Variant, given

_FULL_SAMPLES, _FULL_SPP, _FULL_RESOLUTION = ((16, 32), (32, 64), (64, 128), (128, 256)), 2048, 192


def soft(
    scene: Annotated[
        list[str] | None, typer.Option(metavar="|".join(soft_scenes.SCENES), help="Scene; repeatable [default: all].")
    ] = None,
    samples: Annotated[
        list[str] | None,
        typer.Option(
            metavar="AREA/SKY", help="Samples of each area light and of the sky; repeatable [default: 16/32, 32/64, 64/128]."
        ),
    ] = None,
    resolution: Annotated[int | None, typer.Option(help="Image width and height in pixels [default: 96].")] = None,
    map_resolution: Annotated[int, typer.Option(help="Texels along each side of the map of each sample.")] = 128,
    spp: Annotated[int, typer.Option(help="Samples per pixel of our images.")] = 16,
    reference_spp: Annotated[
        int | None, typer.Option(help="Samples per pixel of each of the two path-traced images [default: 512].")
    ] = None,
    times: Annotated[bool, typer.Option(help="Measure times.")] = True,
    full: Annotated[bool, typer.Option("--full", help="Larger images, more samples: an hour instead of minutes.")] = False,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("soft"),
    resume: Annotated[
        bool, typer.Option("--resume", help="Keep the finished scenes of a killed run with the same settings.")
    ] = False,
    variant: Variant = DEFAULT_VARIANT,
) -> None:
    """Compare images under area lights and skies with path-traced ones: errors, their convergence with samples, and times.

    Writes OUT/soft.json, a summary of it (.md) and a sheet of pictures (.png).
    """
    defaults = soft_experiment.SoftOptions()
    options = soft_experiment.SoftOptions(
        scenes=tuple(scene or defaults.scenes),
        samples=tuple(_pair(text) for text in samples) if samples else _FULL_SAMPLES if full else defaults.samples,
        resolution=given(resolution, _FULL_RESOLUTION if full else defaults.resolution),
        map_resolution=map_resolution,
        spp=spp,
        reference_spp=given(reference_spp, _FULL_SPP if full else defaults.reference_spp),
        timed=times,
        out=out,
        resume=resume,
    )
    set_variant(variant, COLOURED)
    record = soft_experiment.run_soft(options)
    Console().print(soft_report.table(record))
    typer.echo("\n".join(soft_report.reading(record)))
    typer.echo(f"Record and pictures: {out}")


def _pair(text: str) -> tuple[int, int]:
    area, _, sky = text.partition("/")
    if not (area.isdecimal() and sky.isdecimal() and int(area) and int(sky)):
        raise ShadowmapError(f"--samples {text}: give two positive numbers, as in 64/128.")
    return int(area), int(sky)

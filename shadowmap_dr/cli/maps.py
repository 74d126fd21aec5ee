"""The command `shadowmap-dr maps`: all shadow maps on scenes that are hard for them."""

from __future__ import annotations

import typer
from rich.console import Console

from ..experiments.maps import experiment as maps_experiment
from ..variants import COLOURED, DEFAULT_VARIANT, set_variant
from .options import Variant, from_record


@from_record()
def maps(options: maps_experiment.MapsOptions, variant: Variant = DEFAULT_VARIANT) -> None:
    """Compare all shadow maps on scenes that are hard for them, against path tracing.

    Writes OUT/maps.json and a sheet of pictures, OUT/maps.png.
    """
    set_variant(variant, COLOURED)
    Console().print(maps_experiment.table(maps_experiment.run_maps(options)))
    typer.echo(f"Record and pictures: {options.out}")

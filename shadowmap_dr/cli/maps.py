"""The command `shadowmap-dr maps`: all shadow maps on scenes that are hard for them."""

from __future__ import annotations

from ..experiments.maps import experiment as maps_experiment
from ..io import console
from ..variants import COLOURED, DEFAULT_VARIANT, set_variant
from .options import Variant, from_record


@from_record()
def maps(options: maps_experiment.MapsOptions, variant: Variant = DEFAULT_VARIANT) -> None:
    """Compare all shadow maps on scenes that are hard for them, against path tracing.

    Writes OUT/maps.json and sheets of pictures: OUT/maps.png, and OUT/views.png of contacts and cities.
    """
    set_variant(variant, COLOURED)
    record = maps_experiment.run_maps(options)
    for table in maps_experiment.tables(record):
        console.show(table)
    console.result(options.out / ("views.png" if record.get("views") else "maps.png"), options.out / "maps.json")

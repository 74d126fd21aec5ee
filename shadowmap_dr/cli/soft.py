"""The command `shadowmap-dr soft`: extended lights against path tracing."""

from __future__ import annotations

import typer

from ..experiments.soft import experiment as soft_experiment
from ..experiments.soft import report as soft_report
from ..io import console
from ..variants import COLOURED, DEFAULT_VARIANT, set_variant
from .options import Variant, from_record


@from_record(full="Larger images, more samples: an hour instead of minutes.")
def soft(options: soft_experiment.SoftOptions, variant: Variant = DEFAULT_VARIANT) -> None:
    """Compare images under area lights and skies with path-traced ones: errors, their convergence with samples, and times.

    Writes OUT/soft.json, a summary of it (.md) and a sheet of pictures (.png).
    """
    set_variant(variant, COLOURED)
    record = soft_experiment.run_soft(options)
    for table in (soft_report.table(record), soft_report.times_table(record)):
        if table is not None:
            console.show(table)
    typer.echo("\n".join(soft_report.reading(record)))
    console.result(options.out / "soft.png", options.out / "soft.json")

"""The commands `shadowmap-dr gradients ...`: accuracy of the derivatives of shadows, and optimisations with them."""

from __future__ import annotations

from pathlib import Path

import typer
from rich.table import Table

from ..experiments.gradients import convergence as convergence_experiment
from ..experiments.gradients import jacobian as jacobian_experiment
from ..experiments.gradients import plane as plane_experiment
from ..experiments.gradients import report as gradients_report
from ..io import console
from ..variants import DEFAULT_VARIANT, set_variant
from .options import Variant, from_record

app = typer.Typer(help="Measure the derivatives of shadows, and test them in optimisations.", no_args_is_help=True)

_FULL = "Full grid: many minutes instead of two or three."


@app.command()
@from_record(full=_FULL)
def jacobian(options: jacobian_experiment.JacobianOptions, variant: Variant = DEFAULT_VARIANT) -> None:
    """Compare derivative images of a shadow with central differences of our own and of path-traced images.

    Writes OUT/jacobian.json, a summary of it (.md), a sheet of derivative images and a plot.
    """
    set_variant(variant)
    _show(gradients_report.jacobian_table(jacobian_experiment.run_jacobian(options)), options.out, "jacobian")


@app.command()
@from_record(full=_FULL)
def convergence(options: convergence_experiment.ConvergenceOptions, variant: Variant = DEFAULT_VARIANT) -> None:
    """Recover a displaced occluder from its shadow, from near and far.

    Writes OUT/convergence.json, a summary of it (.md), a plot and pictures.
    """
    set_variant(variant)
    record = convergence_experiment.run_convergence(options)
    _show(convergence_experiment.convergence_table(record), options.out, "convergence")


@app.command("minimal-plane")
@from_record()
def minimal_plane(options: plane_experiment.PlaneOptions, variant: Variant = DEFAULT_VARIANT) -> None:
    """Recover one displaced vertex of a square from its shadow, with and without anti-aliased shadow maps.

    Writes OUT/minimal-plane.json, a summary of it (.md), a plot and pictures.
    """
    set_variant(variant)
    _show(plane_experiment.plane_table(plane_experiment.run_plane(options)), options.out, "minimal-plane")


def _show(table: Table, out: Path, name: str) -> None:
    console.show(table)
    # The sentences of the summary only: the table has just been printed.
    text = (out / f"{name}.md").read_text(encoding="utf-8")
    typer.echo("\n".join(line for line in text.splitlines() if line and not line.startswith(("|", "#"))))
    console.result(out / f"{name}.png", out / f"{name}.json")

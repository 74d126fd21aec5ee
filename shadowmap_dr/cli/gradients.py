"""The commands `shadowmap-dr gradients ...`: accuracy of the derivatives of shadows, and optimisations with them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from ..experiments.gradients import convergence as convergence_experiment
from ..experiments.gradients import jacobian as jacobian_experiment
from ..experiments.gradients import plane as plane_experiment
from ..experiments.gradients import report as gradients_report
from ..experiments.gradients import scenes as gradients_scenes
from ..experiments.gradients.images import CANDIDATES
from ..variants import DEFAULT_VARIANT, set_variant
from .options import Variant, given

app = typer.Typer(help="Measure the derivatives of shadows, and test them in optimisations.", no_args_is_help=True)

_FULL_MAPS, _FULL_SPP = (128, 256, 512, 1024), 512
_FULL_DISPLACEMENTS = (0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.45, 0.5, 0.55, 0.6, 0.65, 0.7)
_FULL_FILTERS = (1, 3, 5, 9, 15)

Out = Annotated[Path, typer.Option(help="Folder for the results.")]
Full = Annotated[bool, typer.Option("--full", help="Full grid: many minutes instead of two or three.")]
Resume = Annotated[bool, typer.Option("--resume", help="Keep the measurements of a killed run with the same settings.")]
Candidates = Annotated[
    list[str] | None,
    typer.Option("--candidate", metavar="|".join(CANDIDATES), help="Kind of shadow map; repeatable [default: default]."),
]
FilterSizes = Annotated[
    list[int] | None, typer.Option("--filter-size", help="Texels along each side of the filter, 1 for none; repeatable.")
]


@app.command()
def jacobian(
    motion: Annotated[
        list[str] | None,
        typer.Option(metavar="|".join(gradients_scenes.MOTIONS), help="Motion of the occluder; repeatable [default: all]."),
    ] = None,
    candidate: Candidates = None,
    map_resolution: Annotated[
        list[int] | None, typer.Option(help="Texels along each side of the map; repeatable [default: 256 and 1024].")
    ] = None,
    filter_size: FilterSizes = None,
    resolution: Annotated[int, typer.Option(help="Image width and height in pixels.")] = 512,
    faces: Annotated[int, typer.Option(help="Triangles of the occluder.")] = 130_000,
    spp: Annotated[int | None, typer.Option(help="Samples per pixel of the path-traced images [default: 128].")] = None,
    mitsuba_passes: Annotated[int, typer.Option(help="Passes of Mitsuba's projective integrator, 0 for none.")] = 2,
    full: Full = False,
    out: Out = Path("gradients"),
    resume: Resume = False,
    variant: Variant = DEFAULT_VARIANT,
) -> None:
    """Compare derivative images of a shadow with central differences of our own and of path-traced images.

    Writes OUT/jacobian.json, a summary of it (.md), a sheet of derivative images and a plot.
    """
    defaults = jacobian_experiment.JacobianOptions()
    options = jacobian_experiment.JacobianOptions(
        motions=tuple(motion or defaults.motions),
        candidates=tuple(candidate or (CANDIDATES if full else defaults.candidates)),
        map_resolutions=tuple(map_resolution or (_FULL_MAPS if full else defaults.map_resolutions)),
        filter_sizes=tuple(filter_size or defaults.filter_sizes),
        resolution=resolution,
        faces=faces,
        spp=given(spp, _FULL_SPP if full else defaults.spp),
        mitsuba_passes=mitsuba_passes,
        out=out,
        resume=resume,
    )
    set_variant(variant)
    _show(gradients_report.jacobian_table(jacobian_experiment.run_jacobian(options)), out, "jacobian")


@app.command()
def convergence(
    occluder: Annotated[
        list[str] | None,
        typer.Option(metavar="|".join(convergence_experiment.OCCLUDERS), help="Occluder; repeatable [default: all]."),
    ] = None,
    camera: Annotated[
        list[str] | None, typer.Option(metavar="orthographic|perspective", help="Camera; repeatable [default: both].")
    ] = None,
    candidate: Candidates = None,
    filter_size: FilterSizes = None,
    displacement: Annotated[
        list[float] | None, typer.Option(help="Displacement at the start of a run, along x; repeatable.")
    ] = None,
    map_resolution: Annotated[int, typer.Option(help="Texels along each side of the map.")] = 256,
    resolution: Annotated[int, typer.Option(help="Image width and height in pixels.")] = 512,
    iterations: Annotated[int, typer.Option(help="Steps of the optimiser.")] = 250,
    full: Full = False,
    out: Out = Path("gradients"),
    resume: Resume = False,
    variant: Variant = DEFAULT_VARIANT,
) -> None:
    """Recover a displaced occluder from its shadow, from near and far.

    Writes OUT/convergence.json, a summary of it (.md), a plot and pictures.
    """
    defaults = convergence_experiment.ConvergenceOptions()
    options = convergence_experiment.ConvergenceOptions(
        occluders=tuple(occluder or defaults.occluders),
        cameras=tuple(camera or defaults.cameras),
        candidates=tuple(candidate or defaults.candidates),
        filter_sizes=tuple(filter_size or (_FULL_FILTERS if full else defaults.filter_sizes)),
        displacements=tuple(displacement or (_FULL_DISPLACEMENTS if full else defaults.displacements)),
        map_resolution=map_resolution,
        resolution=resolution,
        iterations=iterations,
        out=out,
        resume=resume,
    )
    set_variant(variant)
    _show(convergence_experiment.convergence_table(convergence_experiment.run_convergence(options)), out, "convergence")


@app.command("minimal-plane")
def minimal_plane(
    camera: Annotated[
        list[str] | None, typer.Option(metavar="orthographic|perspective", help="Camera; repeatable [default: both].")
    ] = None,
    map_resolution: Annotated[int, typer.Option(help="Texels along each side of the map.")] = 256,
    filter_size: Annotated[int, typer.Option(help="Texels along each side of the filter.")] = 3,
    resolution: Annotated[int, typer.Option(help="Image width and height in pixels.")] = 512,
    iterations: Annotated[int, typer.Option(help="Steps of the optimiser.")] = 150,
    out: Out = Path("gradients"),
    variant: Variant = DEFAULT_VARIANT,
) -> None:
    """Recover one displaced vertex of a square from its shadow, with and without anti-aliased shadow maps.

    Writes OUT/minimal-plane.json, a summary of it (.md), a plot and pictures.
    """
    defaults = plane_experiment.PlaneOptions()
    options = plane_experiment.PlaneOptions(
        cameras=tuple(camera or defaults.cameras),
        map_resolution=map_resolution,
        filter_size=filter_size,
        resolution=resolution,
        iterations=iterations,
        out=out,
    )
    set_variant(variant)
    _show(plane_experiment.plane_table(plane_experiment.run_plane(options)), out, "minimal-plane")


def _show(table: Table, out: Path, name: str) -> None:
    Console().print(table)
    # The sentences of the summary only: the table has just been printed.
    text = (out / f"{name}.md").read_text(encoding="utf-8")
    typer.echo("\n".join(line for line in text.splitlines() if line and not line.startswith(("|", "#"))))
    typer.echo(f"Record, pictures and plots: {out}")

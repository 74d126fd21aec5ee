"""The commands `shadowmap-dr face` and `shadowmap-dr face convert`: heads from profile shadows."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, cast

import typer
from rich.console import Console

from ..errors import ShadowmapError
from ..experiments.common.ranges import check_range
from ..experiments.faces import experiment as faces_experiment
from ..experiments.faces import image as faces_image
from ..experiments.faces import problem as faces_problem
from ..experiments.faces import report as faces_report
from ..inverse.faces import convert as convert_model
from ..inverse.faces.morphable import save_model
from ..io import files
from ..variants import COLOURED, DEFAULT_VARIANT, set_variant
from .options import Variant

app = typer.Typer(help="Find a head from its profile shadow.", invoke_without_command=True)


@app.callback()
def face(
    context: typer.Context,
    head: Annotated[
        list[int] | None, typer.Option(help="Seed of an artificial head; repeatable [default: 1, 6, 8, 131].")
    ] = None,
    shadows: Annotated[
        list[int] | None, typer.Option(metavar="1|3", help="Number of shadows; repeatable [default: both].")
    ] = None,
    mode: Annotated[
        list[str] | None,
        typer.Option(
            metavar="|".join(faces_problem.MODES),
            help="Unknowns: identity, identity and expression, or expression of a known head; repeatable [default: identity].",
        ),
    ] = None,
    image: Annotated[
        Path | None, typer.Option(help="Silhouette to find a head for, instead of artificial heads (.png, .jpg, .exr).")
    ] = None,
    prior: Annotated[
        float | None, typer.Option(help="Strength of the prior on the weights, 0 for none [default: 3e-5, 3e-4 with --image].")
    ] = None,
    model: Annotated[Path | None, typer.Option(help="Morphable model (.npz) [default: the head of this package].")] = None,
    iterations: Annotated[int, typer.Option(help="Steps of the optimiser.")] = 400,
    translate: Annotated[bool, typer.Option("--translate", help="Fit the head's position, too (always with --image).")] = False,
    reference: Annotated[
        str, typer.Option(metavar="own|mitsuba", help="Target shadows: rendered by this library, or path-traced.")
    ] = "own",
    height: Annotated[int, typer.Option(help="Rows of the shadow image.")] = 192,
    map_resolution: Annotated[int, typer.Option(help="Texels along each side of a shadow map.")] = 256,
    filter_size: Annotated[int, typer.Option(help="Texels along each side of the filter.")] = 3,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("face"),
    resume: Annotated[bool, typer.Option("--resume", help="Keep finished runs, resume killed ones.")] = False,
    variant: Variant = DEFAULT_VARIANT,
) -> None:
    """Find heads from their profile shadows with a morphable model, and measure the errors.

    Writes OUT/faces.json, tables (.md), shadows, errors drawn on the heads, and the heads (.ply). With --image: the head for a
    silhouette, which is first scaled and aligned with the shadow of the mean head.
    """
    if context.invoked_subcommand is not None:
        return
    if image is not None:
        for name, given in (("--head", head), ("--shadows", shadows)):
            if given:
                raise ShadowmapError(f"{name} chooses artificial heads: leave it out with --image.")
        if reference != "own":
            raise ShadowmapError("--reference is an option of artificial heads: leave it out with --image.")
        modes = mode or ["identity"]
        if len(modes) > 1 or modes[0] not in faces_problem.MODES or modes[0] == "expression":
            raise ShadowmapError(f"--mode {' '.join(modes)}: with --image, choose identity or both.")
        options = faces_image.ImageOptions(
            image=image,
            mode=modes[0],
            model=model,
            iterations=iterations,
            height=height,
            prior=faces_image.PRIOR if prior is None else prior,
            map_resolution=map_resolution,
            filter_size=filter_size,
            out=out,
            resume=resume,
        )
        set_variant(variant, COLOURED)
        record = faces_image.run_image(options)
        typer.echo(
            f"root mean square difference of the shadows: {record['image_error_start']:.4f} at the start, "
            f"{record['image_error']:.4f} at the end"
        )
        typer.echo(f"share of heads whose weights are as far from the mean head's: {record['chance_of_weights']:.2g}")
        for message in faces_image.doubts(record):
            typer.echo(f"warning: {message}", err=True)
        typer.echo(f"Record, pictures and head: {out}")
        return
    defaults = faces_experiment.FaceOptions()
    # `FaceOptions` checks the choices.
    artificial = faces_experiment.FaceOptions(
        seeds=tuple(head or defaults.seeds),
        lights=tuple(shadows or defaults.lights),
        modes=cast(tuple[faces_problem.Mode, ...], tuple(mode or defaults.modes)),
        model=model,
        iterations=iterations,
        prior=defaults.prior if prior is None else prior,
        translate=translate,
        reference=cast(faces_experiment.Reference, reference),
        height=height,
        map_resolution=map_resolution,
        filter_size=filter_size,
        out=out,
        resume=resume,
    )
    set_variant(variant, COLOURED)
    record = faces_experiment.run_faces(artificial)
    for table in faces_report.tables(record):
        Console().print(table)
    typer.echo(f"Record, tables, pictures and heads: {out}")


@app.command("convert")
def convert(
    source: Annotated[
        Path, typer.Argument(help="Folder of OBJ files as ICT-FaceKit's FaceXModel, or .npz of Basel-like arrays.")
    ],
    output: Annotated[Path, typer.Argument(help="Model to write (.npz).")],
    facing: Annotated[
        str, typer.Option(metavar="|".join(convert_model.FACING), help="Axis along which the model's head looks; y is up.")
    ] = "+z",
    neck: Annotated[
        float | None, typer.Option(help="Height, in the model's units, above which vertices belong to the head [default: all].")
    ] = None,
    components: Annotated[int | None, typer.Option(help="Identity components to keep [default: all].")] = None,
    expression_scale: Annotated[
        float | None,
        typer.Option(help="Share of a full expression that a weight of 1 stands for [default: 0.5 for OBJ files, 1 for arrays]."),
    ] = None,
) -> None:
    """Convert a morphable model to the format of this package."""
    if components is not None:
        check_range("--components", components, (1, 100_000))
    for name, value in (("--neck", neck), ("--expression-scale", expression_scale)):
        if value is not None:
            check_range(name, value, (-1e30, 1e30))
    files.check_output(output, (".npz",))
    scale = expression_scale if expression_scale is not None else 0.5 if source.is_dir() else 1.0
    options = convert_model.ConvertOptions(facing=facing, neck=neck, components=components, expression_scale=scale)
    model = convert_model.convert(source, options)
    save_model(output, model)
    typer.echo(f"{output}: {model.describe()}")

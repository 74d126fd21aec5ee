"""The commands `shadowmap-dr face` and `shadowmap-dr face convert`: heads from profile shadows."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Annotated

import typer

from ..errors import ShadowmapError
from ..experiments.faces import experiment as faces_experiment
from ..experiments.faces import image as faces_image
from ..experiments.faces import problem as faces_problem
from ..experiments.faces import report as faces_report
from ..inverse.faces import convert as convert_model
from ..inverse.faces.morphable import save_model
from ..io import console, files
from ..variants import COLOURED, DEFAULT_VARIANT, set_variant
from .options import After, Given, Variant, from_record

app = typer.Typer(help="Find a head from its profile shadow.", invoke_without_command=True)


@app.callback()
@from_record()
def face(
    context: typer.Context,
    given: Given[faces_experiment.FaceOptions],
    image: Annotated[
        Path | None,
        typer.Option(help="Silhouette to find a head for, instead of artificial heads (.png, .jpg, .exr)."),
        After("modes"),
    ] = None,
    variant: Variant = DEFAULT_VARIANT,
) -> None:
    """Find heads from their profile shadows with a morphable model, and measure the errors.

    Writes OUT/faces.json, tables (.md), shadows, errors drawn on the heads, and the heads (.ply). With --image: the head for a
    silhouette, which is first scaled and aligned with the shadow of the mean head.
    """
    if context.invoked_subcommand is not None:
        return
    if image is not None:
        _fit_image(_image_options(given, image), variant)
        return
    options = given.make()
    set_variant(variant, COLOURED)
    record = faces_experiment.run_faces(options)
    for table in faces_report.tables(record):
        console.show(table)
    console.result(options.out / f"{options.modes[0]}-errors.png", options.out / "faces.json")


def _image_options(given: Given[faces_experiment.FaceOptions], image: Path) -> faces_image.ImageOptions:
    """Options of the fit to an image, from those of artificial heads."""
    for name, field in (("--head", "seeds"), ("--shadows", "lights")):
        if field in given:
            raise ShadowmapError(f"{name} chooses artificial heads: leave it out with --image.")
    if given["reference"] != "own":
        raise ShadowmapError("--reference is an option of artificial heads: leave it out with --image.")
    modes = given["modes"]
    if len(modes) > 1 or modes[0] not in faces_problem.MODES or modes[0] == "expression":
        raise ShadowmapError(f"--mode {' '.join(modes)}: with --image, choose identity or both.")
    names = {field.name for field in fields(faces_image.ImageOptions)}
    shared = {name: value for name, value in given.chosen.items() if name in names}
    return faces_image.ImageOptions(image=image, mode=modes[0], **shared)


def _fit_image(options: faces_image.ImageOptions, variant: str) -> None:
    set_variant(variant, COLOURED)
    record = faces_image.run_image(options)
    typer.echo(
        f"root mean square difference of the shadows: {record['image_error_start']:.4f} at the start, "
        f"{record['image_error']:.4f} at the end"
    )
    typer.echo(f"share of heads whose weights are as far from the mean head's: {record['chance_of_weights']:.2g}")
    for message in faces_image.doubts(record):
        console.note(f"warning: {message}")
    name = options.image.stem
    console.result(options.out / f"{name}-shadows.png", options.out / f"{name}-face.json")


@app.command("convert")
@from_record()
def convert(
    source: Annotated[
        Path, typer.Argument(help="Folder of OBJ files as ICT-FaceKit's FaceXModel, or .npz of Basel-like arrays.")
    ],
    output: Annotated[Path, typer.Argument(help="Model to write (.npz).")],
    given: Given[convert_model.ConvertOptions],
) -> None:
    """Convert a morphable model to the format of this package."""
    files.check_output(output, (".npz",))
    scale = given["expression_scale"] if "expression_scale" in given or source.is_dir() else 1.0
    model = convert_model.convert(source, given.make(expression_scale=scale))
    save_model(output, model)
    typer.echo(f"{output}: {model.describe()}")

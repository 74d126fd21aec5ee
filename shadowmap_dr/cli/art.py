"""The command `shadowmap-dr art`: objects whose shadows match pictures."""

from __future__ import annotations

from typing import Annotated

import typer

from ..experiments.art import experiment as art_experiment
from ..experiments.art import stained as art_stained
from ..io import console
from ..variants import COLOURED, DEFAULT_VARIANT, set_variant
from .options import After, Given, Variant, from_record


@from_record()
def art(
    given: Given[art_experiment.ArtOptions],
    text: Annotated[
        list[str] | None,
        typer.Option(metavar="LETTERS", help="Letters instead of an image; repeatable."),
        After("targets"),
    ] = None,
    variant: Variant = DEFAULT_VARIANT,
) -> None:
    """Deform an object until its shadow is a given picture, or its two shadows two pictures.

    With --collection, move, turn and scale copies of a mesh instead: one copy at first, twice as many every 150 steps.
    With --stained, tint the panes of a sheet until the sun throws a picture through them.

    Writes meshes (PLY, OBJ, GLB) or the sheet (EXR, XML), images of shadows and errors, animated pictures, and OUT/art.json.
    """
    letters = (f"text:{letters}" for letters in text or ())
    options = given.make(targets=(*given.chosen.get("targets", ()), *letters))
    set_variant(variant, COLOURED)
    stained = options.stained is not None
    record = art_stained.run_stained(options) if stained else art_experiment.run_art(options)
    console.show(art_stained.table(record) if stained else art_experiment.table(record))
    typer.echo(art_stained.summary(record) if stained else art_experiment.summary(record))
    for message in record["warnings"]:
        console.note(f"warning: {message}")
    console.result(options.out / "picture.png", options.out / "art.json")

"""The command `shadowmap-dr import`: a Mitsuba scene of a model file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..importing import ImportOptions, import_model
from ..io import console
from .options import from_record


@from_record()
def import_command(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="File: .glb, .gltf, .obj (with its .mtl), .ply, .stl or .off.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="SCENE", help="Scene to write (.xml).")],
    options: ImportOptions,
) -> None:
    """Make a Mitsuba scene of a model: meshes, materials, textures, cameras and lights."""
    found = import_model(model, output, options)
    for note in found.notes:
        console.note(f"{model}: {note}.")
    counts = ((found.shapes, "shape"), (found.triangles, "triangle"), (found.cameras, "camera"), (found.lights, "light"))
    listed = ", ".join(f"{count:,} {word}{'s' * (count != 1)}" for count, word in counts)
    typer.echo(f"{found.scene}: {listed} in the file")
    typer.echo(f"Render it: shadowmap-dr render {found.scene} -o {found.scene.with_suffix('.png').name}")

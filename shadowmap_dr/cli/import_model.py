"""The command `shadowmap-dr import`: a Mitsuba scene of a model file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..importing import import_model
from ..importing.scene_file import LONGER_SIDE
from ..io import console as io_console


def import_command(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="File: .glb, .gltf, .obj (with its .mtl), .ply, .stl or .off.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="SCENE", help="Scene to write (.xml).")],
    up: Annotated[
        str, typer.Option(metavar="AXIS", help="Axis that points upwards, y or z, for the camera and sun that are added.")
    ] = "y",
    size: Annotated[
        int, typer.Option(metavar="INTEGER", min=1, max=16384, help="Pixels along the longer side of pictures.")
    ] = LONGER_SIDE,
    daylight: Annotated[
        bool, typer.Option("--daylight/--no-daylight", help="Add a sun and a dim sky to a model without lights.")
    ] = True,
) -> None:
    """Make a Mitsuba scene of a model: meshes, materials, textures, cameras and lights."""
    found = import_model(model, output, up, size, daylight)
    for note in found.notes:
        io_console.notes().print(f"{model}: {note}.", markup=False, soft_wrap=True)
    counts = (
        (found.shapes, "shape"), (found.triangles, "triangle"), (found.cameras, "camera"), (found.lights, "light"),
    )  # fmt: skip
    listed = ", ".join(f"{count:,} {word}{'s' * (count != 1)}" for count, word in counts)
    typer.echo(f"{found.scene}: {listed} in the file")
    typer.echo(f"Render it: shadowmap-dr render {found.scene} -o {found.scene.with_suffix('.png').name}")

"""A model file becomes a Mitsuba scene: the way from one to the other."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from ..errors import ShadowmapError
from ..io.files import check_output
from .reader import read_model
from .scene_file import LONGER_SIDE, write_scene


@dataclass(frozen=True)
class Imported:
    """Summary of an import.

    Attributes:
        scene: path of the XML file.
        shapes, triangles, cameras, lights: numbers of them that the model has.
        notes: sentences about what was added, changed or left out.
        files: all files that were written.
    """

    scene: Path
    shapes: int
    triangles: int
    cameras: int
    lights: int
    notes: tuple[str, ...]
    files: tuple[Path, ...]


def import_model(
    model: str | os.PathLike[str],
    output: str | os.PathLike[str],
    up: str = "y",
    size: int = LONGER_SIDE,
    daylight: bool = True,
) -> Imported:
    """Make a Mitsuba scene of a model file of another program. Names of nodes and materials become ids.

    Args:
        model: `.glb`, `.gltf`, `.obj` (with its `.mtl`), `.ply`, `.stl` or `.off`.
        output: the scene to write, `.xml`. Meshes and pictures go into a folder beside it.
        up: axis that points upwards, `y` or `z`: for the camera and the sun that models without get.
        size: pixels along the longer side of rendered pictures.
        daylight: whether a model without lights gets a sun and a dim sky. Surfaces that glow do not count as lights.

    Raises:
        ShadowmapError: The model cannot be read, or has no triangles.
        OutputError: A file could not be written.
    """
    source, target = Path(model), Path(output)
    if up not in ("y", "z"):
        raise ShadowmapError(f"up is {up!r}: give y or z.")
    if isinstance(size, bool) or not isinstance(size, int) or not 1 <= size <= 16384:
        raise ShadowmapError(f"size is {size!r}: give pixels from 1 to 16384.")
    check_output(target, (".xml",))
    found = read_model(source)
    written = write_scene(found, target, up, size, daylight)
    return Imported(
        scene=target,
        shapes=len(found.parts),
        triangles=sum(len(part.faces) for part in found.parts),
        cameras=len(found.cameras),
        lights=len(found.lights),
        notes=(*found.notes, *written.notes),
        files=tuple(written.files),
    )

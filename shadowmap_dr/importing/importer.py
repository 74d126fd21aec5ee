"""A model file becomes a Mitsuba scene: the way from one to the other."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from ..io.files import check_output
from .options import ImportOptions
from .reader import read_model
from .scene_file import write_scene


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


def import_model(model: str | os.PathLike[str], output: str | os.PathLike[str], options: ImportOptions | None = None) -> Imported:
    """Make a Mitsuba scene of a model file of another program. Names of nodes and materials become ids.

    Args:
        model: `.glb`, `.gltf`, `.obj` (with its `.mtl`), `.ply`, `.stl` or `.off`.
        output: the scene to write, `.xml`. Meshes and pictures go into a folder beside it.
        options: additions, and the size of pictures.

    Raises:
        ShadowmapError: The model cannot be read, or has no triangles.
        OutputError: A file could not be written.
    """
    source, target, options = Path(model), Path(output), options or ImportOptions()
    check_output(target, (".xml",))
    found = read_model(source, options.normals)
    written = write_scene(found, target, options)
    return Imported(
        scene=target,
        shapes=len(found.parts),
        triangles=sum(len(part.faces) for part in found.parts),
        cameras=len(found.cameras),
        lights=len(found.lights),
        notes=(*found.notes, *written.notes),
        files=tuple(written.files),
    )

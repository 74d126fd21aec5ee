"""Meshes and targets that a page may choose by name. No page can name a file."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError
from ..inverse import even_sphere
from ..io import assets
from ..io.meshes import read_placed_mesh
from . import exports
from .modeller import Modeller
from .start_mesh import StartMesh

#: Name of the mesh that no file holds, and of the target without any shadow.
SPHERE, BLANK = "sphere", "blank"


def read_start(path: Path | None) -> StartMesh:
    """Read a mesh file, or make the sphere. Raises ShadowmapError if the file holds no triangle mesh."""
    if path is None:
        vertices, faces = even_sphere()
        return StartMesh(SPHERE, vertices, faces)
    vertices, faces, (middle, scale) = read_placed_mesh(path)
    return StartMesh(path.stem, vertices, faces, middle, scale)


class MeshLibrary:
    """Meshes that a session may begin with: the first one, the sphere, and those of the package.

    Args:
        first: mesh of the command line. Its name stands for it, even if the package has a mesh of that name.
        build: makes a modeller that begins with a mesh. The session's thread calls it.

    Attributes:
        names: names that `load` accepts, the first mesh in front.
    """

    def __init__(self, first: StartMesh, build: Callable[[StartMesh], Modeller]) -> None:
        self.first, self.build = first, build
        self.names = tuple(dict.fromkeys((first.name, SPHERE, *assets.mesh_names())))

    def load(self, name: str) -> StartMesh:
        """A new record of a mesh. Raises ShadowmapError for any other name."""
        if name not in self.names:
            raise ShadowmapError(f"no mesh {name!r}: choose from {', '.join(self.names)}.")
        if name == self.first.name:
            first = self.first
            return StartMesh(first.name, first.vertices, first.faces, first.middle, first.scale)
        return read_start(None if name == SPHERE else assets.mesh(name))


@functools.cache
def target_names() -> tuple[str, ...]:
    """Names that `read_named_target` accepts."""
    return (BLANK, *assets.target_names())


def read_named_target(name: str, seen: npt.NDArray[np.bool_]) -> npt.NDArray[np.float32]:
    """A target (H, W), visibility from 0 to 1, by its name. Figures fill the canvas as in `exports.read_target`.

    Raises ShadowmapError for any other name.
    """
    if name not in target_names():
        raise ShadowmapError(f"no target {name!r}: choose from {', '.join(target_names())}.")
    if name == BLANK:
        return np.ones(seen.shape, np.float32)
    return exports.read_target(assets.target(name).read_bytes(), seen)

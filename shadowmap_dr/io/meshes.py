"""Reading and writing of triangle meshes."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from ..errors import OutputError, ShadowmapError
from .files import atomic

if TYPE_CHECKING:
    import mitsuba as mi

Array = npt.NDArray[np.float32]
Faces = npt.NDArray[np.uint32]


def read_mesh(path: Path) -> tuple[Array, Faces]:
    """(V, 3) vertices, centred and scaled into [-1, 1]^3, and (F, 3) faces of a mesh file. Equal vertices are merged.

    Raises ShadowmapError if the file cannot be read or holds no triangle mesh.
    """
    vertices, faces, _ = read_placed_mesh(path)
    return vertices, faces


def read_placed_mesh(path: Path) -> tuple[Array, Faces, tuple[npt.NDArray[np.float64], float]]:
    """As `read_mesh`, with the mesh's original middle (3,) and scale: the file's vertices are vertices * scale + middle."""
    import trimesh

    try:
        mesh = trimesh.load_mesh(path, process=False)
        if isinstance(mesh, trimesh.Scene):
            mesh = mesh.to_mesh()
        vertices, faces = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces)
    except Exception as error:  # loaders of a dozen formats raise errors of many kinds
        raise ShadowmapError(f"cannot read {path}: it is no mesh, or it is damaged.") from error
    if not len(faces) or not np.isfinite(vertices).all():
        raise ShadowmapError(f"{path} has no triangles, or vertices that are not finite.")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ShadowmapError(f"{path} has {len(vertices)} vertices, but its triangles go from {faces.min()} to {faces.max()}.")
    low, high = vertices.min(0), vertices.max(0)
    scale = float((high - low).max())
    if scale <= 0:
        raise ShadowmapError(f"{path} has no extent.")
    middle = 0.5 * (low + high)
    vertices = (vertices - middle) * (2 / scale)
    unique, index = np.unique(vertices, axis=0, return_inverse=True)
    faces = index.reshape(-1)[faces]
    proper = (faces != np.roll(faces, 1, 1)).all(1)
    if not proper.any():
        raise ShadowmapError(f"all triangles of {path} have two corners at the same place.")
    return unique.astype(np.float32), faces[proper].astype(np.uint32), (middle.astype(np.float64), 0.5 * scale)


def write_ply(path: str | os.PathLike[str], mesh: mi.Mesh) -> None:
    """Write a mesh as a binary PLY file. Raises OutputError if the file cannot be written."""
    with atomic(path) as temporary:
        try:
            mesh.write_ply(str(temporary))
        except RuntimeError as error:  # Mitsuba raises it for a full disk, for instance
            raise OutputError(f"cannot write {path}: {' '.join(str(error).split())}") from error

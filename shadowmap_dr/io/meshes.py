"""Reading and writing of triangle meshes."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import OutputError, ShadowmapError
from .files import atomic

Array = npt.NDArray[np.float32]
Faces = npt.NDArray[np.uint32]


def read_mesh(path: Path) -> tuple[Array, Faces]:
    """(V, 3) vertices, centred and scaled into [-1, 1]^3, and (F, 3) faces of a mesh file; equal vertices are one.

    Raises ShadowmapError where it cannot be read, or is no triangle mesh.
    """
    vertices, faces, _ = read_placed_mesh(path)
    return vertices, faces


def read_placed_mesh(path: Path) -> tuple[Array, Faces, tuple[npt.NDArray[np.float64], float]]:
    """As `read_mesh`, and where the mesh was: its middle (3,) and a scale; vertices * scale + middle are the file's."""
    import trimesh

    try:
        mesh = trimesh.load_mesh(path, process=False)
        if isinstance(mesh, trimesh.Scene):
            mesh = mesh.to_mesh()
        vertices, faces = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces)
    except Exception as error:  # whatever the loader of one of a dozen formats may raise
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


def write_ply(path: str | os.PathLike[str], mesh: Any) -> None:
    """Write a ``mi.Mesh`` as a binary PLY file."""
    with atomic(path) as temporary:
        try:
            mesh.write_ply(str(temporary))
        except RuntimeError as error:  # Mitsuba's, of a full disk and others
            raise OutputError(f"cannot write {path}: {' '.join(str(error).split())}") from error

"""Users' own mesh files in the experiments: loaded by Mitsuba, checked, and scaled into [-1, 1]^3."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...scene.mitsuba_meshes import make_mesh, mesh_buffers

MESH_SUFFIXES = (".ply", ".obj")


def check_suffix(path: Path) -> str:
    """Type of Mitsuba's plug-in for a mesh file; ShadowmapError if there is none."""
    kind = path.suffix.lower()
    if kind not in MESH_SUFFIXES:
        raise ShadowmapError(f"cannot load the object {path}: the suffix {kind!r} is not one of {', '.join(MESH_SUFFIXES)}.")
    return kind[1:]


def load_mesh(path: Path) -> mi.Mesh:
    """``mi.Mesh`` from a file, flat shaded; ShadowmapError if it cannot be read."""
    try:
        return mi.load_dict({"type": check_suffix(path), "filename": str(path), "face_normals": True})
    except RuntimeError as error:
        raise ShadowmapError(f"cannot load the object {path}: {' '.join(str(error).split())}") from error


def positions(mesh: mi.Mesh) -> npt.NDArray[np.float32]:
    """(V, 3) vertices of a mesh."""
    return np.array(mesh_buffers(mesh).positions, np.float32).reshape(-1, 3)


def placement(mesh: mi.Mesh, path: Path) -> tuple[npt.NDArray[np.float64], float]:
    """Centre (3,) of a mesh's bounding box, and the factor that makes its longest side 2.

    Raises ShadowmapError for a mesh without triangles, without extent, or with vertices that are not finite.
    """
    points = positions(mesh).astype(np.float64)
    if mesh.face_count() == 0 or not len(points):
        raise ShadowmapError(f"the object {path} has no triangles: give a triangle mesh.")
    if not np.isfinite(points).all():
        raise ShadowmapError(f"the object {path} has vertices that are not finite (NaN or inf): repair the file.")
    low, high = points.min(axis=0), points.max(axis=0)
    extent = float((high - low).max())
    if extent <= 0:
        raise ShadowmapError(f"the object {path} has no extent: all its vertices lie at {tuple(low.tolist())}.")
    return (low + high) / 2, 2 / extent


def occluder(
    name: str,
    points: npt.NDArray[np.float32],
    faces: npt.NDArray[np.uint32],
    colour: tuple[float, ...] = (0.5, 0.5, 0.5),
) -> mi.Mesh:
    """A ``mi.Mesh`` of (V, 3) vertices and (F, 3) faces, diffuse on both sides."""
    diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(colour)}}
    return make_mesh(name, points, faces, mi.load_dict({"type": "twosided", "bsdf": diffuse}))

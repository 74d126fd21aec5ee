"""Objects of the experiments."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...scene.mitsuba_meshes import make_mesh, mesh_buffers


def load_mesh(path: Path) -> mi.Mesh:
    """``mi.Mesh`` of one of this package's files, flat shaded; ShadowmapError if it cannot be read."""
    try:
        return mi.load_dict({"type": "ply", "filename": str(path), "face_normals": True})
    except RuntimeError as error:
        raise ShadowmapError(f"cannot load the object {path}: {' '.join(str(error).split())}") from error


def positions(mesh: mi.Mesh) -> npt.NDArray[np.float32]:
    """(V, 3) vertices of a mesh."""
    return np.array(mesh_buffers(mesh).positions, np.float32).reshape(-1, 3)


def occluder(
    name: str,
    points: npt.NDArray[np.float32],
    faces: npt.NDArray[np.uint32],
    colour: tuple[float, ...] = (0.5, 0.5, 0.5),
    *,
    both_sides: bool = True,
) -> mi.Mesh:
    """A ``mi.Mesh`` of (V, 3) vertices and (F, 3) faces, flat shaded and diffuse, on both sides or outside only."""
    diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(colour)}}
    return make_mesh(name, points, faces, mi.load_dict({"type": "twosided", "bsdf": diffuse} if both_sides else diffuse))

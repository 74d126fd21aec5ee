"""Reading and writing of triangle meshes."""

from __future__ import annotations

import io
import json
import os
import struct
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from ..errors import OutputError, ShadowmapError, warn
from . import obj, off, ply
from .files import atomic, check_readable

if TYPE_CHECKING:
    import mitsuba as mi

Array = npt.NDArray[np.float32]
Faces = npt.NDArray[np.uint32]

#: Suffixes of mesh files that can be read.
SUFFIXES = (".ply", ".obj", ".stl", ".off", ".glb")
#: Most bytes of a mesh file; most triangles of a mesh.
MOST_BYTES, MOST_TRIANGLES = 1_000_000_000, 50_000_000


def check_suffix(path: Path) -> str:
    """Suffix of a mesh file without the dot; ShadowmapError if such files cannot be read."""
    kind = path.suffix.lower()
    if kind not in SUFFIXES:
        raise ShadowmapError(f"cannot load the object {path}: the suffix {kind!r} is not one of {', '.join(SUFFIXES)}.")
    return kind[1:]


def read_mesh(path: Path) -> tuple[Array, Faces]:
    """(V, 3) vertices, centred and scaled into [-1, 1]^3, and (F, 3) faces of a mesh file. Equal vertices are merged.

    Raises ShadowmapError if the file cannot be read or holds no triangle mesh.
    """
    vertices, faces, _ = read_placed_mesh(path)
    return vertices, faces


def read_placed_mesh(path: Path) -> tuple[Array, Faces, tuple[npt.NDArray[np.float64], float]]:
    """As `read_mesh`, with the mesh's original middle (3,) and scale: the file's vertices are vertices * scale + middle."""
    path = Path(path)
    kind = check_suffix(path)
    check_readable(path)
    try:
        size = path.stat().st_size
        if size > MOST_BYTES:
            raise ShadowmapError(
                f"cannot read {path}: {size / 1e6:.0f} MB are more than {MOST_BYTES / 1e6:.0f}; decimate the mesh."
            )
        vertices, faces = _loaded(path.read_bytes(), kind)
    except ShadowmapError:
        raise
    except OSError as error:
        raise ShadowmapError(f"cannot read {path}: {error.strerror or error}.") from error
    except _Unreadable as error:
        raise ShadowmapError(f"cannot read {path}: {error}.") from error
    except Exception as error:  # loaders of these formats raise errors of many kinds
        raise ShadowmapError(f"cannot read {path}: it is no mesh, or it is damaged.") from error
    if not len(faces):
        raise ShadowmapError(f"{path} has no triangles: give a triangle mesh, no points and no curves.")
    if not np.isfinite(vertices).all():
        raise ShadowmapError(f"{path} has vertices that are not finite (NaN or inf): repair the file.")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ShadowmapError(f"{path} has {len(vertices)} vertices, but its triangles go from {faces.min()} to {faces.max()}.")
    used = np.unique(faces)
    if len(used) < len(vertices):  # vertices of no triangle have no place in the extent
        vertices, faces = vertices[used], np.searchsorted(used, faces)
    low, high = vertices.min(0), vertices.max(0)
    scale = float((high - low).max())
    if not 0 < scale < np.inf:
        raise ShadowmapError(f"{path} has no extent: all its vertices lie at {tuple(low.tolist())}.")
    middle = 0.5 * (low + high)
    # Scaled in double precision: coordinates of surveys lie far from zero.
    unique, index = np.unique(((vertices - middle) * (2 / scale)).astype(np.float32), axis=0, return_inverse=True)
    if len(unique) < len(vertices):
        warn(f"{path}: {len(vertices)} vertices lie at {len(unique)} places and have been welded.")
    faces = index.reshape(-1)[faces]
    proper = (faces != np.roll(faces, 1, 1)).all(1)
    if not proper.any():
        raise ShadowmapError(f"all triangles of {path} have two corners at the same place.")
    return unique, faces[proper].astype(np.uint32), (middle, 0.5 * scale)


class _Unreadable(Exception):
    """A reason why a file cannot be read, one clause for a message."""


def _loaded(data: bytes, kind: str) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """(V, 3) vertices and (F, 3) triangles of a file's content."""
    import trimesh

    binary = None
    if kind == "ply":
        try:
            header = ply.parse(data)
        except ValueError as error:
            raise _Unreadable(str(error)) from error
        data, binary = header.cleaned, header if header.order else None
    elif kind == "glb":
        _check_counts(data)
    elif kind == "off":
        try:
            return off.parse(data)
        except ValueError as error:
            raise _Unreadable(str(error)) from error
    elif kind == "obj":
        data = obj.split_concave_faces(data.decode("ascii", "replace").encode("ascii", "replace"))  # names in any encoding
    materials = {"skip_materials": True} if kind in ("ply", "obj", "glb") else {}
    try:
        mesh = trimesh.load_mesh(io.BytesIO(data), file_type=kind, process=False, **materials)
        if isinstance(mesh, trimesh.Scene):
            instances = [mesh.graph[node][1] for node in mesh.graph.nodes_geometry]
            count = sum(len(getattr(mesh.geometry[name], "faces", ())) for name in instances)
            if count > MOST_TRIANGLES:
                raise _Unreadable(f"its instances have {count} triangles, more than {MOST_TRIANGLES}; decimate the mesh")
            mesh = mesh.to_mesh()
        faces = getattr(mesh, "faces", np.empty((0, 3)))  # point clouds have none
        return np.asarray(mesh.vertices, np.float64).reshape(-1, 3), np.asarray(faces, np.int64).reshape(-1, 3)
    except Exception:  # of many kinds: trimesh refuses binary lists of different lengths, as of triangles beside quads
        if binary is None:
            raise
    try:
        return ply.binary_mesh(binary)
    except ValueError as error:
        raise _Unreadable(str(error)) from error


def _check_counts(data: bytes) -> None:
    """_Unreadable if a binary glTF file announces more values than it holds: the loader would make room for them."""
    (length,) = struct.unpack_from("<I", data, 12)
    for accessor in json.loads(data[20 : 20 + length]).get("accessors", ()):
        if int(accessor["count"]) > len(data):
            raise _Unreadable(f"it announces {accessor['count']} values, but has {len(data)} bytes")


def write_ply(path: str | os.PathLike[str], mesh: mi.Mesh) -> None:
    """Write a mesh as a binary PLY file. Raises OutputError if the file cannot be written."""
    with atomic(path) as temporary:
        try:
            mesh.write_ply(str(temporary))
        except RuntimeError as error:  # Mitsuba raises it for a full disk, for instance
            raise OutputError(f"cannot write {path}: {' '.join(str(error).split())}") from error

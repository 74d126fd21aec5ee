"""Faces of a scene by what they do with light: opaque, translucent, or unseen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...jit.arrays import device_array, ravel
from ...jit.types import Bool, UInt32
from ...raster import CoplanarCreases, Topology, build_topology
from ...scene.load import SceneData
from ...scene.mitsuba_objects import passes_evenly

# Thickness of a flat part, relative to its width; most parts that are looked at.
_FLAT, _FEW = 1e-4, 64


@dataclass(frozen=True)
class Faces:
    """The translucent faces of a scene, T of them. Static.

    Attributes:
        index: ``UInt32`` (T,), number of each translucent face.
        corners: ``UInt32`` (3 T,), their vertices.
        topology: edges of the translucent faces alone. A surface's edges count only where it is seen itself.
        cutouts: True if transmittance may vary over a surface, as it does with opacities in textures.
        room: most of these faces that a ray meets, wherever shapes move; None if that is not known.
        bsdfs: BSDFs of these faces.
    """

    index: UInt32
    corners: UInt32
    topology: Topology
    cutouts: bool
    room: int | None
    bsdfs: tuple[mi.BSDF, ...]

    def creases(self, creases: dict[str, Any]) -> dict[str, Any]:
        """Those of the creases of all faces (``PlacedShapes.creases``) that the translucent faces have."""
        corner = dr.arange(mi.UInt32, dr.width(self.corners))
        face = corner // 3
        edge = 3 * dr.gather(mi.UInt32, self.index, face) + corner - 3 * face

        found, edges, folds = dict(creases), creases.get("creases"), creases.get("folds")
        if edges is not None:
            found["creases"] = dr.gather(mi.Bool, edges, edge)
        if folds is not None:
            normals = ravel(dr.gather(mi.Vector4f, folds.normals, self.index))
            found["folds"] = CoplanarCreases(dr.gather(mi.Bool, folds.edges, edge), normals)
        dr.eval(found)
        return found


def faces_of(data: SceneData, positions: np.ndarray) -> tuple[Bool | None, Faces | None]:
    """(mask (F,) of the opaque faces, None if all are; the translucent faces, None without any), on the host, once.

    ``positions``: (V, 3) vertices of the scene's geometry.
    """
    geometry = data.geometry
    if not any(info.see_through for info in geometry.shapes):
        return None, None
    shape = geometry.face_shape.numpy()
    opaque = device_array(mi.Bool, np.array([not info.see_through for info in geometry.shapes])[shape])
    translucent = np.array([info.see_through and not info.unseen for info in geometry.shapes])[shape]
    if not translucent.any():
        return opaque, None
    index = np.flatnonzero(translucent).astype(np.uint32)
    corners = geometry.faces.numpy().reshape(-1, 3)[index]
    every = np.ones(len(index), bool)
    topology = build_topology(corners, positions, mi.UInt32, geometry.vertex_shape.numpy(), every)
    pairs = zip(data.sources, geometry.shapes, strict=True)
    bsdfs = tuple(dict.fromkeys(source.shape.bsdf() for source, info in pairs if info.see_through and not info.unseen))
    cutouts = not all(passes_evenly(bsdf) for bsdf in bsdfs)
    numbers, vertices = device_array(mi.UInt32, index), device_array(mi.UInt32, corners.ravel())
    return opaque, Faces(numbers, vertices, topology, cutouts, _room(topology, corners, positions), bsdfs)


def _room(topology: Topology, corners: np.ndarray, positions: np.ndarray) -> int | None:
    """Number of connected parts if there are few and all of them are flat, else None. ``corners``: (T, 3), of the faces."""
    if topology.part_count > _FEW:
        return None
    parts = topology.parts.numpy()
    for part in range(topology.part_count):
        points = positions[np.unique(corners[parts == part])].astype(np.float64)
        spread = np.linalg.eigvalsh(np.cov(points.T))
        if spread[0] > _FLAT**2 * spread[2]:
            return None
    return topology.part_count

"""Smoothness of a mesh: a regularisation term, and the share of triangles that are folded over."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...jit.types import Float
from ...raster import NO_VERTEX, Topology

#: If the normals of neighbouring triangles differ by more than this, at least one of the triangles is inverted.
INVERTED_DEG = 150.0
# Below this, a triangle has no area, and no normal to compare.
_LEAST_LENGTH = 1e-20


def normal_consistency(vertices: Float, topology: Topology) -> Float:
    """Mean of 1 - cos(angle between normals) over the edges between two triangles: 0 for a plane, at most 2.

    Args:
        vertices: ``Float`` (3V,). Attached.
        topology: of the mesh.

    Returns:
        ``Float`` (1,). Edges at a triangle without area count 0, without a gradient.
    """
    edge = dr.arange(mi.UInt32, topology.count)
    i, j = dr.gather(mi.Vector2u, topology.edges, edge)
    k, m = dr.gather(mi.Vector2u, topology.opposite, edge)
    inner = m != NO_VERTEX
    a, b, c, d = (dr.gather(mi.Point3f, vertices, index, inner) for index in (i, j, k, m))
    along = b - a
    one, other = dr.cross(along, c - a), dr.cross(d - a, along)
    square = dr.squared_norm(one) * dr.squared_norm(other)
    proper = inner & (square > _LEAST_LENGTH)
    cosine = dr.dot(one, other)
    divisor = dr.select(proper, square, 1)
    cosine = cosine * dr.rsqrt(divisor)
    counted = dr.select(inner, mi.Float(1), 0)
    count = dr.maximum(dr.sum(counted), 1)
    deviation = dr.select(proper, 1 - cosine, 0)
    return dr.sum(deviation) / count


def inverted_share(vertices: npt.ArrayLike, faces: npt.ArrayLike) -> float:
    """Share of the triangles, 0 to 1, whose normals differ by more than 150 degrees from a neighbour's.

    Args:
        vertices: (V, 3).
        faces: (F, 3). Neighbours share two vertex indices.
    """
    p, f = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    normals = np.cross(p[f[:, 1]] - p[f[:, 0]], p[f[:, 2]] - p[f[:, 0]])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals /= np.where(length > 0, length, 1)
    pairs = np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]])
    face = np.tile(np.arange(len(f)), 3)
    low, high = pairs.min(1), pairs.max(1)
    order = np.lexsort((high, low))
    same = (low[order][1:] == low[order][:-1]) & (high[order][1:] == high[order][:-1])
    one, other = face[order][:-1][same], face[order][1:][same]
    folded = (normals[one] * normals[other]).sum(1) < np.cos(np.radians(INVERTED_DEG))
    inverted = np.zeros(len(f), np.bool_)
    inverted[one[folded]] = inverted[other[folded]] = True
    return float(inverted.mean())

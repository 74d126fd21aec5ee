"""Distances between the surfaces of two heads with the same triangles, from the neck upwards."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError, install_hint

FloatArray = npt.NDArray[np.float64]

# Triangles are sampled by points no farther apart than this share of the surface's extent. The triangles of the nearest points
# are the candidates for the nearest triangle.
_SPACING = 0.01
_CANDIDATES = 16
# Points whose candidates are tested together; bounds the memory.
_CHUNK = 20_000


@dataclass(frozen=True)
class SurfaceDistance:
    """Distances between two surfaces, in the units of their vertices.

    Attributes:
        mean: mean distance of points spread evenly over one surface from the other; averaged over both directions.
        hausdorff: the largest distance found, in either direction (the vertices are among the points).
        forward, backward: mean from the first surface to the second, and from the second to the first.
    """

    mean: float
    hausdorff: float
    forward: float
    backward: float


def check_libraries() -> None:
    """ShadowmapError if SciPy, which measures distances, is not installed."""
    if importlib.util.find_spec("scipy") is None:
        raise ShadowmapError(f"measuring faces needs scipy: {install_hint('faces')}.")


def surface_distance(
    a: npt.ArrayLike, b: npt.ArrayLike, faces: npt.ArrayLike, mask: npt.ArrayLike, *, samples: int = 30_000, seed: int = 0
) -> SurfaceDistance:
    """Mean and Hausdorff distance, both directions.

    Args:
        a, b: (V, 3) vertices of two surfaces.
        faces: (F, 3) triangles of both.
        mask: (V,) bool: points are sampled on triangles whose three vertices are all in the mask. Distances are
            to the whole other surface, so that the border of the mask does not count as a difference.
        samples: points spread over each surface, beside its vertices.
        seed: of the points.
    """
    first, second = (np.asarray(p, np.float64) for p in (a, b))
    triangles, inside = np.asarray(faces), np.asarray(mask, bool)
    forward, backward = (
        _one_way(source, target, triangles, inside, samples, seed) for source, target in ((first, second), (second, first))
    )
    return SurfaceDistance(
        mean=float(0.5 * (forward[0] + backward[0])),
        hausdorff=float(max(forward[1], backward[1])),
        forward=forward[0],
        backward=backward[0],
    )


def _one_way(
    source: FloatArray, target: FloatArray, faces: npt.NDArray[Any], mask: npt.NDArray[np.bool_], samples: int, seed: int
) -> tuple[float, float]:
    import trimesh

    kept = faces[mask[faces].all(1)]
    if not len(kept):
        raise ShadowmapError("no triangle lies above the neck: check the model's mask.")
    mesh = trimesh.Trimesh(source, kept, process=False)
    points, _ = trimesh.sample.sample_surface(mesh, samples, seed=seed)
    spread = distances(points, target, faces)
    corners = distances(source[np.unique(kept)], target, faces)
    return float(spread.mean()), float(max(spread.max(), corners.max()))


def distances(points: npt.ArrayLike, vertices: npt.ArrayLike, faces: npt.ArrayLike) -> FloatArray:
    """(N,) distance of each point (N, 3) from a surface: vertices (V, 3), triangles (F, 3)."""
    import scipy.spatial
    import trimesh

    query, p, f = np.asarray(points, np.float64), np.asarray(vertices, np.float64), np.asarray(faces)
    triangles = p[f]
    extent = float(np.ptp(p, axis=0).max())
    sites, owner = _stand_ins(triangles, _SPACING * extent)
    _, nearest = scipy.spatial.cKDTree(sites).query(query, k=min(_CANDIDATES, len(sites)))
    candidates = owner[nearest.reshape(len(query), -1)]
    result = np.empty(len(query))
    for start in range(0, len(query), _CHUNK):
        part = slice(start, start + _CHUNK)
        among = candidates[part]
        repeated = np.repeat(query[part], among.shape[1], axis=0)
        closest = trimesh.triangles.closest_point(triangles[among.ravel()], repeated)
        result[part] = np.linalg.norm(closest - repeated, axis=1).reshape(among.shape).min(1)
    return result


def _stand_ins(triangles: FloatArray, spacing: float) -> tuple[FloatArray, npt.NDArray[np.int64]]:
    """Points on all triangles, no farther apart than ``spacing``, and the triangle of each."""
    edges = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(1)
    parts = np.maximum(1, np.ceil(edges / spacing)).astype(np.int64)
    points, owners = [], []
    for n in np.unique(parts):
        chosen = np.flatnonzero(parts == n)
        # Centroids of the upright parts of a triangle whose edges are cut into n pieces.
        i, j = (a.ravel() for a in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
        i, j = i[i + j < n], j[i + j < n]
        weights = np.stack([i + 1 / 3, j + 1 / 3, n - i - j - 2 / 3], 1) / n
        points.append(np.einsum("sc,fcd->fsd", weights, triangles[chosen]).reshape(-1, 3))
        owners.append(np.repeat(chosen, len(weights)))
    return np.concatenate(points), np.concatenate(owners)

"""Drawings of the tests of anti-aliasing, and their references."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from shadowmap_dr.raster import antialias, build_topology, rasterize


def render(clip, faces: np.ndarray, topology, size: int, colors: np.ndarray | None = None):  # noqa: ANN001, ANN201
    """White (or per-face coloured) triangles on black, anti-aliased; also the raw image."""
    out = rasterize(clip, mi.TensorXu(faces), (size, size))
    if colors is None:
        value = dr.select(out.valid, mi.Float(1), mi.Float(0))
    else:
        value = dr.gather(mi.Float, mi.Float(colors.astype(np.float32)), out.triangle, out.valid)
    return antialias(value, out, clip, topology), value


def topology_of(faces: np.ndarray, world: np.ndarray):  # noqa: ANN201
    return build_topology(faces, world, mi.UInt32)


def smooth_weights(size: int) -> np.ndarray:
    x, y = np.meshgrid((np.arange(size) + 0.5) / size, (np.arange(size) + 0.5) / size)
    return (0.5 + 0.3 * np.sin(5 * x + 1) * np.cos(4 * y) + 0.4 * x).astype(np.float32)


def supersampled(clip: np.ndarray, faces: np.ndarray, size: int, factor: int = 16) -> np.ndarray:
    """Coverage of each pixel by the union of some triangles in front of the far plane."""
    n = size * factor
    ndc = (2 * np.arange(n) + 1) / n - 1
    covered = np.zeros((n, n), bool)
    for face in faces:
        inverse = np.linalg.inv(clip[face][:, [0, 1, 3]].astype(np.float64))
        b = ndc[None, :, None] * inverse[0] + ndc[:, None, None] * inverse[1] + inverse[2]
        z = b @ clip[face][:, 2]
        covered |= (b >= 0).all(-1) & (np.abs(z) <= 1)
    return covered.reshape(size, factor, size, factor).mean((1, 3))


def to_clip(world, matrix: np.ndarray):  # noqa: ANN001, ANN201
    """(V, 3) tensor -> (V, 4) clip-space tensor, attached."""
    p = dr.unravel(mi.Point3f, world.array)
    rows = [sum(float(matrix[r, c]) * p[c] for c in range(3)) + float(matrix[r, 3]) for r in range(4)]
    return mi.TensorXf(dr.ravel(mi.Point4f(*rows)), shape=(world.shape[0], 4))


TRIANGLE = np.array([[-0.71, -0.63, 0, 1], [0.66, -0.38, 0, 1], [-0.12, 0.77, 0, 1]], np.float32)

"""Depths of pixels: by planes of all triangles, or of those alone that pixels see, where triangles are more than pixels."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh

from shadowmap_dr.raster import rasterize
from shadowmap_dr.raster.screen_planes import depth_at, pixel_depth, pixels, planes


def scene(images: int, subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    """(clip-space vertices (images, V, 4), faces (F, 3)) of a sphere in perspective, larger in each image."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    points = np.asarray(sphere.vertices)
    made = []
    for k in range(images):
        p = points * (1 + 0.4 * k) + [0.3, -0.2, 2.5]
        made.append(np.stack([p[:, 0], p[:, 1], 1.01 * p[:, 2] - 0.2, p[:, 2]], 1))
    return np.array(made, np.float32), np.asarray(sphere.faces, np.uint32)


@pytest.mark.parametrize("images", [1, 3])
@pytest.mark.parametrize("inverted", [None, True])
def test_both_ways_agree(variant: str, images: int, inverted: bool | None) -> None:
    """In value and derivative."""
    points, faces = scene(images, 3)
    size, index = 16, mi.UInt32(faces.ravel())
    assert faces.shape[0] > size * size
    reciprocal = None if inverted is None else mi.Bool(np.arange(images) % 2 == 0)
    weight = mi.Float(np.random.default_rng(0).uniform(size=images * size * size).astype(np.float32))
    results = []

    def by_all(raster: Any, positions: Any) -> Any:
        found, _ = planes(positions, index, raster, False, reciprocal)
        return depth_at(found, *pixels(raster), raster.valid)

    for depth_of in (by_all, lambda raster, positions: pixel_depth(raster, positions, index, reciprocal)):
        positions = mi.Float(points.ravel())
        dr.enable_grad(positions)
        raster = rasterize(mi.TensorXf(positions, points.shape), mi.TensorXu(index, faces.shape), (size, size), batch=images)
        depth, dx, dy = depth_of(raster, positions)
        found = [part.numpy() for part in (depth, dx, dy)]
        dr.backward(dr.sum(depth * weight))
        results.append([*found, dr.grad(positions).numpy()])
    assert 0.1 < (results[0][0] != 1).mean() < 0.9
    for one, other in zip(*results, strict=True):
        assert np.abs(one).max() > 0.01
        np.testing.assert_allclose(one, other, atol=1e-6 * np.abs(one).max())


def test_depths_are_the_rasterizers(variant: str) -> None:
    points, faces = scene(1, 3)
    index = mi.UInt32(faces.ravel())
    positions = mi.Float(points.ravel())
    raster = rasterize(mi.TensorXf(positions, points[0].shape), mi.TensorXu(index, faces.shape), (16, 16))
    depth, dx, _ = pixel_depth(raster, positions, index)
    np.testing.assert_allclose(depth.numpy(), raster.depth.numpy(), atol=1e-5)
    assert (dx.numpy()[~raster.valid.numpy()] == 0).all()

"""Invariants of the raster primitives, for meshes that a program makes up: vertices on pixel centres, slivers, equal depths."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from raster_scenes import topology_of

from shadowmap_dr.raster import antialias, rasterize

HEIGHT, WIDTH, TRIANGLES = 9, 13, 4
NONE = 0xFFFFFFFF
# The same examples in each run, and a fixture that stays the same for all of them.
MADE_UP = settings(
    max_examples=60,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.filter_too_much],
)

# Multiples of half a pixel, on and off the image; and some numbers between.
across = st.one_of(
    st.integers(-4, 2 * WIDTH + 4).map(lambda k: k / WIDTH - 1), st.floats(-1.5, 1.5, width=32, allow_subnormal=False)
)
along = st.one_of(
    st.integers(-4, 2 * HEIGHT + 4).map(lambda k: k / HEIGHT - 1), st.floats(-1.5, 1.5, width=32, allow_subnormal=False)
)
depth = st.one_of(st.sampled_from([-0.5, 0.0, 0.5]), st.floats(-0.875, 0.875, width=32, allow_subnormal=False))
corner = st.tuples(across, along, depth)
large = st.lists(corner, min_size=3, max_size=3)
# Smaller than a pixel, around the centre of one: its neighbours claim more than all of it.
offset = st.tuples(*[st.floats(-0.5, 0.5, width=32, allow_subnormal=False)] * 2)
small = st.builds(
    lambda column, row, z, offsets: [
        ((2 * column + 1 + 2 * x) / WIDTH - 1, (2 * row + 1 + 2 * y) / HEIGHT - 1, z) for x, y in offsets
    ],
    *(st.integers(0, WIDTH - 1), st.integers(0, HEIGHT - 1), depth, st.lists(offset, min_size=3, max_size=3)),
)
mesh = st.lists(st.one_of(large, small), min_size=TRIANGLES, max_size=TRIANGLES).map(lambda parts: sum(parts, []))


def clip_of(corners: list[tuple[float, float, float]]) -> np.ndarray:
    return np.array([(*c, 1) for c in corners], np.float32)


def drawn(clip: np.ndarray, faces: np.ndarray) -> Any:
    return rasterize(mi.TensorXf(clip), mi.TensorXu(faces.astype(np.uint32)), (HEIGHT, WIDTH))


@MADE_UP
@given(corners=mesh)
def test_indices_and_barycentrics_are_in_range(variant: str, corners: list[Any]) -> None:
    clip = clip_of(corners)
    out = drawn(clip, np.arange(3 * TRIANGLES).reshape(-1, 3))
    triangle, valid = out.triangle.numpy(), out.valid.numpy()
    assert ((triangle < TRIANGLES) == valid).all() and (triangle[~valid] == NONE).all()
    u, v, z = (a.numpy()[valid] for a in (out.u, out.v, out.depth))
    assert (u >= -1e-5).all() and (v >= -1e-5).all() and (u + v <= 1 + 1e-5).all()
    depths = clip[:, 2].reshape(-1, 3)[triangle[valid]]
    assert (z >= depths.min(1) - 1e-4).all() and (z <= depths.max(1) + 1e-4).all()


@MADE_UP
@given(points=st.lists(st.tuples(across, along), min_size=4, max_size=4, unique=True))
def test_two_triangles_share_no_pixel_and_leave_none_between_them(variant: str, points: list[Any]) -> None:
    """A convex quadrilateral, cut along either diagonal."""
    corners = np.array(points, np.float64)
    corners = corners[np.argsort(np.arctan2(*(corners - corners.mean(0)).T[::-1]))]
    following = np.roll(corners, -1, 0) - corners
    turns = following[:, 0] * np.roll(following, -1, 0)[:, 1] - following[:, 1] * np.roll(following, -1, 0)[:, 0]
    assume((turns > 1e-3).all())
    clip = np.c_[corners, np.zeros(4), np.ones(4)].astype(np.float32)
    # The other triangle of each pair, alone, too: pixels of both would be hidden by the nearer one.
    pairs = [np.array([[0, 1, 2], [0, 2, 3]]), np.array([[0, 1, 3], [1, 2, 3]])]
    both = [drawn(clip, pair).valid.numpy() for pair in pairs]
    alone = [[drawn(clip, triangle[None]).valid.numpy() for triangle in pair] for pair in pairs]
    for (one, other), whole in zip(alone, both, strict=True):
        assert not (one & other).any() and ((one | other) == whole).all()
    assert (both[0] == both[1]).all()


@MADE_UP
@given(corners=mesh)
def test_blended_moments_are_those_of_a_distribution(variant: str, corners: list[Any]) -> None:
    """Weights are convex: ones stay ones, and a mean of squares is no less than the square of the mean."""
    clip, faces = clip_of(corners), np.arange(3 * TRIANGLES).reshape(-1, 3)
    assume(any(np.abs(np.linalg.det(np.c_[clip[face][:, :2], np.ones(3)])) > 1e-6 for face in faces))
    out = drawn(clip, faces)
    depths = dr.select(out.valid, mi.Float(out.depth), 1)
    flat = antialias([mi.Float(1), depths, depths * depths], out, mi.TensorXf(clip), topology_of(faces, clip[:, :3]))
    one, mean, square = flat.numpy().reshape(-1, 3).T
    assert np.allclose(one, 1, atol=1e-5)
    assert (square - mean**2 >= -1e-5).all()
    values = depths.numpy()
    assert (mean >= values.min() - 1e-5).all() and (mean <= values.max() + 1e-5).all()

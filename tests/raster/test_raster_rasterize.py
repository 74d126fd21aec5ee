"""The rasterizer against a brute-force twin, and the promises of its docstring."""

from __future__ import annotations

import brute_force
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr.raster import NO_TRIANGLE, rasterize, tile_lists


def run(pos: np.ndarray, faces: np.ndarray, height: int, width: int):  # noqa: ANN201
    return rasterize(mi.TensorXf(pos), mi.TensorXu(faces), (height, width))


def as_ids(out) -> np.ndarray:  # noqa: ANN001
    ids = out.triangle.numpy().astype(np.int64)
    return np.where(ids == NO_TRIANGLE, -1, ids)


@pytest.mark.parametrize("block", range(6))
def test_random_soups_match_the_twin(variant: str, block: int) -> None:
    wrong = total = 0
    for seed in range(block * 40, block * 40 + 40):
        pos, faces, height, width = brute_force.random_soup(*(np.random.default_rng(n) for n in (seed, seed // 8)))
        out = run(pos, faces, height, width)
        ref = brute_force.rasterize(pos, faces, height, width)
        ids = as_ids(out)
        decided = (ref["margin_px"] > 1 / 256) & (ref["margin_depth"] > 1e-5)
        assert (ids == ref["triangle"])[decided].all(), seed
        wrong += int((ids != ref["triangle"]).sum())
        total += ids.size
        same = (ids == ref["triangle"]) & (ids >= 0) & decided
        np.testing.assert_allclose(out.u.numpy()[same], ref["uv"][same, 0], atol=1e-4, err_msg=f"seed {seed}")
        np.testing.assert_allclose(out.v.numpy()[same], ref["uv"][same, 1], atol=1e-4, err_msg=f"seed {seed}")
        # A float32 barycentric is good to half an ulp; across the camera plane (corner w of both signs) that costs w_max / w.
        w = np.abs(pos[faces[ids[same]]][..., 3])
        condition = np.maximum(1, 0.1 * w.max(1) / np.abs(out.w.numpy()[same])) if same.any() else 1
        assert (np.abs(out.depth.numpy()[same] - ref["depth"][same]) <= 1e-5 * condition).all(), seed
    if block != 0:  # lattice soups have ties on purpose, spread over the blocks
        assert wrong / total < 0.02


@pytest.mark.parametrize("capacity", [32, 2])
def test_large_triangles_match_the_twin(variant: str, capacity: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Triangles that cover many tiles, tilted so that they hide each other in parts; also with lists that overflow."""
    monkeypatch.setattr(tile_lists, "CAPACITY", capacity)
    for seed in range(12):
        rng, sizes = np.random.default_rng(500 + seed), np.random.default_rng(seed // 4)
        count, height, width = 40, int(sizes.integers(60, 150)), int(sizes.integers(60, 150))
        pos = np.c_[rng.uniform(-2.5, 2.5, (3 * count, 2)), rng.uniform(-1.3, 1.3, 3 * count), np.ones(3 * count)]
        if seed % 2:
            pos *= rng.uniform(0.3, 2, (3 * count, 1))
        if seed % 3 == 0:  # behind the camera with a corner
            pos[::7, 3] *= -1
        faces = np.arange(3 * count).reshape(-1, 3)
        ref = brute_force.rasterize(pos.astype(np.float32), faces, height, width)
        ids = as_ids(run(pos.astype(np.float32), faces.astype(np.uint32), height, width))
        decided = (ref["margin_px"] > 1 / 256) & (ref["margin_depth"] > 1e-5)
        assert decided.mean() > 0.9 and (ids >= 0).mean() > 0.5
        assert (ids == ref["triangle"])[decided].all(), seed


def test_slivers_and_layers_match_the_twin(variant: str) -> None:
    """Hundreds of diagonal slivers narrower than a pixel before a stack of layers that fill the image."""
    rng = np.random.default_rng(9)
    count, size = 300, 160
    middle, direction = rng.uniform(-1, 1, (count, 2)), np.array([0.6, 0.5])
    ends = [middle - direction, middle + direction, middle + direction + np.array([0.7, -0.7]) / size]
    slivers = np.stack([np.c_[e, rng.uniform(-0.9, 0, count), np.ones(count)] for e in ends], 1).reshape(-1, 4)
    layers = np.stack([[-1.1, -1.2, 0, 1], [3.5, -1.0, 0, 1], [-1.3, 3.7, 0, 1]])[None].repeat(60, 0)
    layers[..., 2] = rng.uniform(0.1, 0.9, (60, 1))
    pos = np.concatenate([slivers, layers.reshape(-1, 4)]).astype(np.float32)
    faces = np.arange(len(pos)).reshape(-1, 3)
    ref = brute_force.rasterize(pos, faces, size, size)
    ids = as_ids(run(pos, faces.astype(np.uint32), size, size))
    decided = (ref["margin_px"] > 1 / 256) & (ref["margin_depth"] > 1e-5)
    assert (ids == ref["triangle"])[decided].all()
    assert np.unique(ids).size > 200 and ids.max() >= count


def test_undecided_pixels_are_rare(variant: str) -> None:
    wrong = total = 0
    for seed in range(60):
        rng = np.random.default_rng(1000 + seed)
        pos = np.c_[rng.uniform(-1, 1, (30, 3)), np.ones(30)].astype(np.float32)
        faces = rng.integers(0, 30, (40, 3)).astype(np.uint32)
        ids = as_ids(run(pos, faces, 64, 64))
        wrong += int((ids != brute_force.rasterize(pos, faces, 64, 64)["triangle"]).sum())
        total += ids.size
    assert wrong / total < 1e-3


def test_shared_edges_leave_no_hole_and_no_double_owner(variant: str) -> None:
    """A triangulated square whose inner vertices sit on pixel centres and elsewhere: each pixel has exactly one owner."""
    rng = np.random.default_rng(3)
    n, size = 9, 32
    g = np.linspace(-1, 1, n)
    x, y = np.meshgrid(g, g)
    inner = (np.abs(x) < 1) & (np.abs(y) < 1)
    jitter = np.where(rng.random(x.shape) < 0.5, 1 / size, rng.uniform(-0.08, 0.08, x.shape))
    x, y = x + inner * jitter, y + inner * np.roll(jitter, 1, 0)
    w = rng.uniform(0.5, 2, x.shape)
    pos = np.stack([x * w, y * w, 0 * x, w], -1).reshape(-1, 4).astype(np.float32)
    quads = [(j * n + i, j * n + i + 1, (j + 1) * n + i + 1, (j + 1) * n + i) for j in range(n - 1) for i in range(n - 1)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], np.uint32)
    owners = np.zeros(size * size, int)
    for f in faces:
        owners += as_ids(run(pos, f[None], size, size)) >= 0
    assert (owners == 1).all()


@pytest.mark.parametrize("resolution", [(1, 1), (1, 7), (3, 2), (130, 5), (64, 4096)])
def test_any_resolution(variant: str, resolution: tuple[int, int]) -> None:
    rng = np.random.default_rng(5)
    pos = np.c_[rng.uniform(-1.5, 1.5, (12, 2)), rng.uniform(-0.9, 0.9, 12), np.ones(12)].astype(np.float32)
    faces = rng.integers(0, 12, (10, 3)).astype(np.uint32)
    out, ref = run(pos, faces, *resolution), brute_force.rasterize(pos, faces, *resolution)
    decided = (ref["margin_px"] > 1 / 256) & (ref["margin_depth"] > 1e-5)
    assert (as_ids(out) == ref["triangle"])[decided].all()


def test_batch_equals_single_images(variant: str) -> None:
    rng = np.random.default_rng(7)
    pos = np.concatenate([rng.uniform(-1, 1, (5, 20, 3)), np.ones((5, 20, 1))], -1).astype(np.float32)
    faces = rng.integers(0, 20, (30, 3)).astype(np.uint32)
    for size in ((21, 34), (77, 90)):
        both = as_ids(run(pos, faces, *size)).reshape(5, -1)
        for b in range(5):
            assert (both[b] == as_ids(run(pos[b], faces, *size))).all()


def test_deterministic_with_equal_depths(variant: str) -> None:
    pos = np.array([[-1, -1, 0, 1], [1, -1, 0, 1], [0, 1, 0, 1]], np.float32)
    faces = np.tile(np.array([[0, 1, 2]], np.uint32), (500, 1))
    assert set(as_ids(run(pos, faces, 32, 32))) == {-1, 0}


def test_barycentrics_carry_gradients(variant: str) -> None:
    pos = np.array([[-1.2, -0.9, 0.3, 1.1], [1.4, -0.7, -0.2, 0.8], [0.1, 1.3, 0.5, 1.5]], np.float32)
    faces = np.array([[0, 1, 2]], np.uint32)
    rng = np.random.default_rng(0)
    weights = [mi.Float(rng.normal(size=64).astype(np.float32)) for _ in range(4)]

    rest = rasterize(mi.TensorXf(pos), mi.TensorXu(faces), (8, 8))
    inside = (rest.u > 0.05) & (rest.v > 0.05) & (rest.u + rest.v < 0.95)

    def value(p) -> mi.Float:  # noqa: ANN001
        out = rasterize(p, mi.TensorXu(faces), (8, 8))
        terms = (out.u, out.v, out.depth, out.w)
        return dr.sum(sum(dr.select(inside, t * k, 0) for t, k in zip(terms, weights, strict=True)))

    p = mi.TensorXf(pos)
    dr.enable_grad(p)
    dr.backward(value(p))
    grad = dr.grad(p).numpy()
    for i in range(12):
        step = np.zeros(12, np.float32)
        step[i] = 2e-3
        step = step.reshape(3, 4)
        difference = (value(mi.TensorXf(pos + step)) - value(mi.TensorXf(pos - step))).numpy()[0] / 4e-3
        assert abs(difference - grad.flat[i]) < 2e-2 * max(1, np.abs(grad).max()), i


def test_bad_input_is_named(variant: str) -> None:
    pos = np.zeros((3, 4), np.float32)
    face = np.array([[0, 1, 2]], np.uint32)
    with pytest.raises(ValueError, match="vertex 7"):
        run(pos, np.array([[0, 1, 7]], np.uint32), 4, 4)
    with pytest.raises(ValueError, match="0 x 4"):
        run(pos, face, 0, 4)
    with pytest.raises(ValueError, match="4097"):
        run(pos, face, 4097, 4)
    with pytest.raises(ValueError, match="shape"):
        run(pos[:, :3], face, 4, 4)
    with pytest.raises(ValueError, match="faces"):
        run(pos, face[:0], 4, 4)
    p, f = mi.TensorXf(pos), mi.TensorXu(face)
    for arguments, message in (
        ((pos, f, (4, 4)), "positions are of type ndarray"),
        ((mi.TensorXd(pos), f, (4, 4)), "positions are of type TensorXf64"),
        ((p, face, (4, 4)), "faces are of type ndarray"),
        ((None, f, (4, 4)), "positions are of type NoneType"),
        ((p, None, (4, 4)), "faces are of type NoneType"),
        ((p, mi.TensorXf(face.astype(np.float32)), (4, 4)), "faces are of type TensorXf; expected .* integer"),
        ((p, f, (8.7, 4)), "whole pixels"),
        ((p, f, 4), "whole pixels"),
    ):
        with pytest.raises(ValueError, match=message):
            rasterize(*arguments)
    with pytest.raises(ValueError, match="batch is 0"):
        rasterize(p.array, f, (4, 4), batch=0)


def test_degenerate_and_non_finite_triangles_are_not_drawn(variant: str) -> None:
    pos = np.array([[-1, -1, 0, 1], [1, 1, 0, 1], [0, 0, 0, 1], [np.nan, 0, 0, 1], [np.inf, 1, 0, 1]], np.float32)
    faces = np.array([[0, 1, 2], [0, 0, 1], [0, 1, 3], [0, 1, 4]], np.uint32)
    assert (as_ids(run(pos, faces, 16, 16)) == -1).all()


def test_corners_with_w_zero(variant: str) -> None:
    """The edge between two of them is infinitely far away: a floor may begin right below the camera."""
    pos = np.array([[-1, -1, 0, 0], [1, -1, 0, 0], [0, 1, 0, 1], [0.5, -1, 0, 0]], np.float32)
    for faces in ([[0, 1, 2]], [[1, 0, 2]], [[0, 3, 2], [2, 3, 1]]):
        faces = np.array(faces, np.uint32)
        ref = brute_force.rasterize(pos, faces, 32, 32)
        decided = ref["margin_px"] > 1 / 256
        assert (ref["triangle"] >= 0).sum() > 600
        assert (as_ids(run(pos, faces, 32, 32)) == ref["triangle"])[decided].all()


def test_triangles_that_reach_far_behind_the_near_plane(variant: str) -> None:
    rng = np.random.default_rng(0)
    seen = 0
    for _ in range(100):
        pos = np.c_[rng.uniform(-1, 1, (3, 3)), rng.uniform(0.5, 2, 3)]
        pos[:, 2] *= pos[:, 3]
        away = rng.normal(size=4)
        away[2] = -abs(away[2]) - 0.5
        pos[rng.integers(3)] = 1e8 * away
        pos = pos.astype(np.float32)
        ref = brute_force.rasterize(pos, np.array([[0, 1, 2]]), 64, 64)
        decided = (ref["margin_px"] > 0.05) & (ref["margin_depth"] > 0.01)
        seen += (ref["triangle"] >= 0).sum()
        assert (as_ids(run(pos, np.array([[0, 1, 2]], np.uint32), 64, 64)) == ref["triangle"])[decided].all()
    assert seen > 10_000


@pytest.mark.parametrize("near_camera", [False, True])
def test_a_million_triangles(variant: str, near_camera: bool) -> None:
    n = 708
    g = np.linspace(-1, 1, n)
    x, y = np.meshgrid(g, g)
    z = -2.0 + 0.2 * np.sin(9 * x) * np.cos(7 * y) - (0.0 if near_camera else 2.0)
    clip = np.c_[x.ravel(), y.ravel(), z.ravel(), np.ones(x.size)] @ brute_force.perspective().T
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.uint32)
    assert len(faces) > 999_000
    out = run(clip.astype(np.float32), faces, 128, 128)
    ids = as_ids(out).reshape(128, 128)
    assert (ids[40:88, 40:88] >= 0).all()


def test_alpha_test_sees_through_layers_in_order(variant: str) -> None:
    """Random soups with some faces transparent equal the soups without these faces, up to the number of layers."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        height, width = (40, 33) if seed else (120, 97)
        pos = np.c_[rng.uniform(-1, 1, (24, 3)), np.ones(24)].astype(np.float32)
        faces = rng.integers(0, 24, (30, 3)).astype(np.uint32)
        clear = rng.random(30) < 0.3
        flags = mi.Bool(clear)

        def transparent(out, flags=flags):  # noqa: ANN001, ANN202
            return dr.gather(mi.Bool, flags, out.triangle, out.valid)

        out = rasterize(mi.TensorXf(pos), mi.TensorXu(faces), (height, width), transparent=transparent, layers=31)
        want = as_ids(run(pos, faces[~clear], height, width))
        kept = np.r_[np.nonzero(~clear)[0], -1]
        assert (as_ids(out) == kept[want]).all()
        one = rasterize(mi.TensorXf(pos), mi.TensorXu(faces), (height, width), transparent=transparent, layers=1)
        assert (as_ids(one) == as_ids(run(pos, faces, height, width))).all()

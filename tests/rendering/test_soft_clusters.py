"""Parts of equal importance: of surfaces and of skies."""

from __future__ import annotations

import numpy as np
import pytest

from shadowmap_dr.rendering.extended_lights.clusters import sky_clusters, surface_clusters


def pieces(count: int, seed: int = 0, kind: str = "even") -> tuple[np.ndarray, np.ndarray]:
    """Points on a bent surface, and their weights."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform(-1, 1, (count, 2))
    points = np.stack([uv[:, 0], uv[:, 1], 0.3 * np.sin(3 * uv[:, 0])], -1)
    weights = {"even": np.ones(count), "random": rng.uniform(0.1, 1.0, count), "steep": np.exp(4 * uv[:, 0])}[kind]
    return points, weights


def test_clusters_keep_to_one_side_of_an_edge() -> None:
    """The faces of a box far from everything; where something is near, clusters stay compact instead."""
    rng = np.random.default_rng(0)
    face = np.repeat(np.arange(6), 200)
    points, normals = rng.uniform(-1, 1, (1200, 3)), np.zeros((1200, 3))
    axis, sign = face // 2, 1.0 - 2 * (face % 2)
    points[np.arange(1200), axis] = sign
    normals[np.arange(1200), axis] = sign

    def mixed(reach: float) -> float:
        cluster, _ = surface_clusters(points, np.ones(1200), 32, normals, np.full(1200, reach))
        return float(np.mean([len(np.unique(face[cluster == k])) > 1 for k in range(32)]))

    assert mixed(4.0) <= 0.2 and mixed(0.0) >= 0.4


def test_bent_parts_are_halved_before_flat_ones() -> None:
    """Half of the weight is a flat square, half a tube: the tube gets most of the clusters."""
    rng = np.random.default_rng(0)
    flat = np.concatenate([rng.uniform(-1, 1, (800, 2)), np.zeros((800, 1))], axis=1)
    angle = rng.uniform(0, 2 * np.pi, 800)
    around = np.stack([np.cos(angle), np.sin(angle), np.zeros(800)], axis=1)
    tube = 0.1 * around + np.stack([np.full(800, 5.0), np.zeros(800), rng.uniform(-1, 1, 800)], axis=1)
    normals = np.concatenate([np.tile([0.0, 0.0, 1.0], (800, 1)), around])
    points, weights = np.concatenate([flat, tube]), np.ones(1600)
    cluster, _ = surface_clusters(points, weights, 12, normals, np.full(1600, 3.0))
    of_tube = len(np.unique(cluster[800:]))
    assert of_tube >= 8 and not set(cluster[800:]) & set(cluster[:800])


@pytest.mark.parametrize("kind", ["even", "random", "steep"])
@pytest.mark.parametrize("count", [1, 2, 7, 32, 100])
def test_clusters_of_a_surface_weigh_about_the_same(count: int, kind: str) -> None:
    points, weights = pieces(40 * count, kind=kind)
    cluster, chosen = surface_clusters(points, weights, count)
    assert cluster.dtype == np.uint32 and cluster.shape == (len(points),) and chosen.shape == (count,)
    sums = np.bincount(cluster, weights, count)
    assert sums.sum() == pytest.approx(weights.sum()) and len(sums) == count
    # Halves are as equal as pieces allow; where the number is no power of two, some parts are halved once more than others.
    assert sums.min() > 0.3 * sums.mean() and sums.max() < 2.2 * sums.mean()


def test_representative_is_the_member_nearest_to_the_mean() -> None:
    points, weights = pieces(600, kind="random")
    cluster, chosen = surface_clusters(points, weights, 24)
    for k in range(24):
        members = np.flatnonzero(cluster == k)
        mean = (points[members] * weights[members, None]).sum(0) / weights[members].sum()
        distances = [float(np.linalg.norm(points[m] - mean)) for m in members]
        assert chosen[k] == members[int(np.argmin(distances))]


def test_clusters_are_compact() -> None:
    """The spread within clusters is that of squares of the same area, up to a third, not that of stripes or random parts."""
    points, weights = pieces(6400)
    cluster, _ = surface_clusters(points, weights, 64)
    spread = np.mean([points[cluster == k][:, :2].var(0).sum() for k in range(64)])
    square = 4.0 / 64
    assert spread == pytest.approx(2 * square / 12, rel=0.35)


@pytest.mark.parametrize("count", [1, 5, 16])
def test_as_many_clusters_as_pieces(count: int) -> None:
    points, weights = pieces(count, kind="steep")
    cluster, chosen = surface_clusters(points, weights, count)
    assert sorted(cluster) == list(range(count)) and sorted(chosen) == list(range(count))


def test_one_heavy_piece_and_pieces_in_one_place() -> None:
    points, weights = pieces(64)
    weights[17] = 1e9
    cluster, chosen = surface_clusters(points, weights, 32)
    assert np.bincount(cluster, minlength=32).min() == 1 and (cluster == cluster[17]).sum() <= 33
    assert len(set(chosen)) == 32
    cluster, _ = surface_clusters(np.zeros((64, 3)), np.ones(64), 32)
    assert (np.bincount(cluster, minlength=32) == 2).all()


def sky(rows: int, kind: str) -> np.ndarray:
    """Energy of the cells of a sky."""
    theta = (np.arange(rows) + 0.5) / rows * np.pi
    weights = np.sin(theta)[:, None] * np.ones(2 * rows)
    if kind == "random":
        weights = weights * np.random.default_rng(3).uniform(0, 1, weights.shape)
    if kind == "sun":
        weights = 1e-3 * weights
        weights[rows // 3, rows // 2] += 10 * weights.sum()
    return weights


@pytest.mark.parametrize("kind", ["even", "random", "sun"])
@pytest.mark.parametrize("count", [1, 3, 64, 100])
def test_clusters_of_a_sky_are_rectangles_without_gaps(count: int, kind: str) -> None:
    weights = sky(32, kind)
    cluster = sky_clusters(weights, count)
    assert cluster.dtype == np.uint32 and set(cluster.ravel()) == set(range(count))
    for k in range(count):
        rows, columns = np.nonzero(cluster == k)
        assert len(rows) == (np.ptp(rows) + 1) * (np.ptp(columns) + 1)
    sums = np.bincount(cluster.ravel(), weights.ravel(), count)
    if kind != "sun":
        assert sums.max() < 2.5 * sums.mean() and sums.min() > 0.25 * sums.mean()
    elif count > 60:
        # The sun is on its own, or nearly so: it takes up no more than a few cells.
        assert (cluster == cluster[32 // 3, 32 // 2]).sum() < 10


def test_sky_of_as_many_cells_as_clusters() -> None:
    assert sorted(sky_clusters(sky(4, "random"), 32).ravel()) == list(range(32))


def test_dark_parts_of_a_sky_still_belong_somewhere() -> None:
    weights = np.zeros((8, 16))
    weights[2, 3] = 1
    assert set(sky_clusters(weights, 12).ravel()) == set(range(12))

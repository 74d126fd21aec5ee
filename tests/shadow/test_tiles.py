"""Tiles of a directional light's image plane: small texels where many points are, kept while they are, blended at borders."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
import pytest

from shadowmap_dr.shadow import (
    Frusta,
    Tiles,
    Views,
    directional_view,
    fit_tiles,
    spot_view,
    stack_views,
    to_light_space,
    with_depths_from_planes,
)
from shadowmap_dr.shadow.light_camera import of_map
from shadowmap_dr.shadow.tiles import BAND, TileNumbers, neighbour, rows_of, tile_of

Array = npt.NDArray[np.float64]
pytestmark = pytest.mark.usefixtures("variant")


def views_of(direction: tuple[float, float, float], count: int) -> Views:
    return stack_views([directional_view(mi.Vector3f(direction))] * count)


def receding(count: int = 20000, seed: int = 1) -> Array:
    """Points (N, 3) on a ground as a camera above it sees them: dense before it, sparse far away; a few high roofs."""
    generator = np.random.default_rng(seed)
    away = 5 / np.tan(generator.uniform(0.01, 0.8, count))
    side = generator.uniform(-0.6, 0.6, count) * away
    return np.stack([away, side, generator.choice([0.0, 12.0], count)], 1)


def seen(points: Array) -> tuple[mi.Point3f, mi.Bool]:
    return mi.Point3f(points.T.astype(np.float32)), dr.full(mi.Bool, True, len(points))


def in_plane(views: Views, points: Array) -> Array:
    p = to_light_space(of_map(views, mi.UInt32(0), views.count), mi.Point3f(points.T.astype(np.float32)))
    return np.stack([p.x.numpy(), p.y.numpy()], 1)


def rectangles(tiles: Tiles) -> Array:
    """(M, 4): x0, y0, x1, y1."""
    return np.stack([column.numpy() for column in tiles.columns()[:4]], 1)


def holders(tiles: Tiles, xy: Array) -> Array:
    """Number of each point's tile, by brute force; -1 where none or several hold it."""
    box = rectangles(tiles)
    inside = ((xy[:, None] >= box[:, :2]) & (xy[:, None] < box[:, 2:])).all(-1)
    return np.where(inside.sum(1) == 1, inside.argmax(1), -1)


def mean_size(xy: Array, parts: Array) -> float:
    """Mean over the points of the diagonal of what holds all points of the same part: texels' sides are proportional to it."""
    sizes = [np.hypot(*np.ptp(xy[parts == k], axis=0)) * (parts == k).sum() for k in np.unique(parts)]
    return float(sum(sizes) / len(xy))


def medians(xy: Array, number: int) -> Array:
    """Leaves of a k-d tree with equally many points in each, whose longer sides are halved."""
    parts = np.zeros(len(xy), int)
    count = 1
    while count < number:
        for k in reversed(range(count)):  # 2 k and 2 k + 1 are free then
            own = np.flatnonzero(parts == k)
            axis = int(np.ptp(xy[own], axis=0).argmax())
            parts[own] = 2 * k + (xy[own, axis] >= np.median(xy[own, axis]))
        count *= 2
    return parts


def best_cut(xy: Array) -> float:
    """Least mean size of two parts, each with an eighth of the points at least, by brute force over 400 borders."""
    found = []
    for axis in (0, 1):
        for border in np.quantile(xy[:, axis], np.linspace(0.125, 0.875, 200)):
            found.append(mean_size(xy, xy[:, axis] >= border))
    return min(found)


@pytest.mark.parametrize("number", [2, 4, 8, 16])
@pytest.mark.parametrize("direction", [(0.3, 0.5, -1.0), (0.0, 0.0, -1.0), (-1.0, 0.2, -0.3)])
def test_tiles_have_small_texels_where_many_points_are(direction: tuple[float, float, float], number: int) -> None:
    points, views = receding(), views_of(direction, number)
    tiles = fit_tiles(views, [(0, number)], seen(points), None)
    assert tiles is not None
    xy = in_plane(views, points)
    found = holders(tiles, xy)
    for rows in (None, rows_of(tiles.by_name())):  # few points gather the numbers of tiles, many select from them
        numbers = TileNumbers.of(tiles.by_name(), (0, number), rows)
        assert (numbers.rows is None) == (rows is None or number > 8)
        np.testing.assert_array_equal(tile_of(numbers, *(mi.Float(xy[:, k]) for k in (0, 1))).numpy(), found)
    counts = np.bincount(found, minlength=number)  # fails if a point has no tile
    # Each cut leaves an eighth of the points on either side.
    assert counts.min() > 0.9 * len(points) / 8 ** np.log2(number)
    assert mean_size(xy, found) < 0.85 * mean_size(xy, medians(xy, number))
    if number == 2:
        assert mean_size(xy, found) < 1.08 * best_cut(xy)


@pytest.mark.parametrize("kind", ["directional", "spot"])
def test_depths_count_from_the_plane_that_points_lie_on(kind: str) -> None:
    """Points within 5 of a slope, hundreds apart along the light: differences along rays stay, those across them vanish."""
    points = receding() * [1, 1, 0.3]
    points[:, 2] += 0.4 * points[:, 0] - 0.2 * points[:, 1]
    if kind == "directional":
        views = views_of((0.3, 0.5, -1.0), 4)
    else:
        axes = (mi.Point3f(1, 0, 0), mi.Point3f(0, -1, 0), mi.Point3f(0, 0, -1))
        views = stack_views([spot_view(mi.Point3f(100, 0, 900), *axes, mi.Float(1.7))] * 4)
    tiles = fit_tiles(views, [(0, 4)], seen(points), None)
    assert tiles is not None
    moved = with_depths_from_planes(views, tiles)
    xy = in_plane(views, points) if kind == "directional" else np.zeros((len(points), 2))
    before = []
    for k in range(4 if kind == "directional" else 1):
        own = points[holders(tiles, xy) == k] if kind == "directional" else points
        old, new = (to_light_space(of_map(v, mi.UInt32(k), 4), seen(own)[0]) for v in (views, moved))
        behind = own + 10 * (dr.ravel(views.forward).numpy()[:3])
        np.testing.assert_allclose(new.x.numpy(), old.x.numpy())
        if kind == "spot":
            np.testing.assert_array_equal(new.z.numpy(), old.z.numpy())
            continue
        before.append(np.ptp(old.z.numpy()))
        assert np.ptp(new.z.numpy()) < 10
        farther = to_light_space(of_map(moved, mi.UInt32(k), 4), seen(behind)[0]).z.numpy()
        np.testing.assert_allclose(farther - new.z.numpy(), 10, atol=2e-3)
    assert kind == "spot" or max(before) > 150


def test_lights_have_tiles_of_their_own() -> None:
    """Maps 1 to 4 and 6 to 7; maps 0 and 5 are no tiles."""
    points, masked = receding(), np.arange(20000) % 3 > 0
    views = stack_views(
        [directional_view(mi.Vector3f(d)) for d in ((0, 0, -1), *((1, 0, -1),) * 4, (0, 1, -1), *((0, -1, -1),) * 2)]
    )
    tiles = fit_tiles(views, [(1, 4), (6, 2)], (seen(points)[0], mi.Bool(masked)), None)
    assert tiles is not None
    box = rectangles(tiles)
    assert np.isinf(box[[0, 5]]).all() and np.isfinite(box[1:5]).any(1).all() and np.isfinite(box[6:8]).sum() == 2
    for first, number in ((1, 4), (6, 2)):
        p = to_light_space(of_map(views, mi.UInt32(first), views.count), seen(points)[0])
        counts = np.bincount(
            tile_of(TileNumbers.of(tiles.by_name(), (first, number)), p.x, p.y).numpy()[masked] - first, minlength=number
        )
        assert counts.min() > 0.9 * masked.sum() / 8 ** np.log2(number)


def test_tiles_stay_while_their_texels_are_small() -> None:
    points, views = receding(), views_of((0.3, 0.5, -1.0), 4)
    first = fit_tiles(views, [(0, 4)], seen(points), None)
    again = fit_tiles(views, [(0, 4)], seen(receding(seed=2) + [0.3, 0.2, 0.0]), first)
    assert first is not None and again is not None
    np.testing.assert_array_equal(rectangles(again), rectangles(first))
    tilted = fit_tiles(views, [(0, 4)], seen(points + points[:, :1] * [0, 0, 0.3]), again)
    assert tilted is not None and not np.array_equal(tilted.slope_x.numpy(), first.slope_x.numpy())
    farther = fit_tiles(views, [(0, 4)], seen(points + [400.0, 0.0, 0.0]), again)
    assert farther is not None
    assert not np.array_equal(rectangles(farther), rectangles(first))
    moved = in_plane(views, points + [400.0, 0.0, 0.0])
    assert mean_size(moved, holders(farther, moved)) < 0.85 * mean_size(moved, holders(first, moved))


def test_no_points_and_equal_points_end_in_tiles_all_the_same() -> None:
    views = views_of((0.3, 0.5, -1.0), 4)
    nothing = mi.Point3f(np.zeros((3, 50), np.float32)), dr.full(mi.Bool, False, 50)
    for points in (nothing, (nothing[0] + 2, dr.full(mi.Bool, True, 50))):
        tiles = fit_tiles(views, [(0, 4)], points, None)
        assert tiles is not None
        found = tile_of(TileNumbers.of(tiles.by_name(), (0, 4)), points[0].x, points[0].y).numpy()
        assert found.max() < 4
        assert not tiles.slope_x.numpy().any() and not tiles.slope_y.numpy().any()


@pytest.mark.parametrize("selected", [False, True])
def test_shares_meet_at_borders(selected: bool) -> None:
    """One half on either side of a border, none beyond the band, and the same from both sides."""
    points, views, number = receding(), views_of((0.0, 0.0, -1.0), 4), 4
    tiles = fit_tiles(views, [(0, number)], seen(points), None)
    assert tiles is not None
    halves = mi.Float([10.0, 20.0, 30.0, 40.0]), mi.Float([15.0, 25.0, 35.0, 45.0])
    columns = {**tiles.by_name(), "half_x": halves[0], "half_y": halves[1]}
    numbers = TileNumbers.of(columns, (0, number), rows_of(columns) if selected else None)
    box = rectangles(tiles)
    generator = np.random.default_rng(0)
    for k in range(number):
        for axis in (0, 1):
            border = box[k, axis]
            if not np.isfinite(border):
                continue
            low, high = (np.clip(box[k, 1 - axis + end], -500, 500) for end in (0, 2))
            along = generator.uniform(low + 0.3 * (high - low), high - 0.3 * (high - low), 50)
            for gap in (1e-4, 0.05, 3.0):
                sides = []
                for sign in (1, -1):
                    xy = np.empty((50, 2), np.float32)
                    xy[:, axis], xy[:, 1 - axis] = border + sign * gap, along
                    x, y = mi.Float(xy[:, 0]), mi.Float(xy[:, 1])
                    tile = tile_of(numbers, x, y)
                    other, share = neighbour(numbers, tile, x, y)
                    sides.append((tile.numpy(), other.numpy(), share.numpy()))
                if gap == 3.0:
                    assert not sides[0][2].any() and not sides[1][2].any()
                    continue
                np.testing.assert_array_equal(sides[0][0], sides[1][1])
                np.testing.assert_array_equal(sides[0][1], sides[1][0])
                np.testing.assert_allclose(sides[0][2], sides[1][2], atol=1e-3)
                size = np.array(halves[axis])[np.stack([sides[0][0], sides[0][1]])].min(0)
                np.testing.assert_allclose(sides[0][2], np.maximum(0.5 - 0.5 * gap / (BAND * size), 0), atol=2e-3)


def test_stored_fits_keep_their_tiles() -> None:
    views = views_of((0.3, 0.5, -1.0), 4)
    tiles = fit_tiles(views, [(0, 4)], seen(receding()), None)
    row = dr.arange(mi.Float, 4)
    fit = Frusta(*(row + k for k in range(8)), tiles=tiles)
    other = Frusta(*(row * 0 for _ in range(8)), tiles=Tiles.whole(dr.llvm.ad, 4))
    back = other.with_arrays(fit.arrays())
    for one, two in zip([*fit.columns(), *fit.tiles.columns()], [*back.columns(), *back.tiles.columns()], strict=True):
        np.testing.assert_array_equal(one.numpy(), two.numpy())
    joined = Frusta.joined([Frusta(*(row[:2] for _ in range(8))), fit])
    assert joined.tiles is not None and np.isinf(rectangles(joined.tiles)[:2]).all()
    np.testing.assert_array_equal(rectangles(joined.part(2, 4).tiles), rectangles(fit.tiles))

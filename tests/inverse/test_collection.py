"""Shadow art from copies of one mesh."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.inverse import Collection, even_sphere, shadow_view
from shadowmap_dr.inverse.shadow_art import collection as module

SIZE = 48
BOX = (
    np.array([[x, y, z] for x in (-1, 1) for y in (-0.5, 0.5) for z in (-0.25, 0.25)], np.float32),
    np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
              [1, 5, 7], [1, 7, 3]]),
)  # fmt: skip


def bar():
    """Dark where |x| < 1.5 and |y| < 0.5, in a view from -2 to 2."""
    line = 4 * (np.arange(SIZE) + 0.5) / SIZE - 2
    x, y = np.meshgrid(line, -line)
    return np.where((np.abs(x) < 1.5) & (np.abs(y) < 0.5), 0.0, 1.0)


def balls(**options):
    return Collection(*even_sphere(4, 1.0), [shadow_view(size=SIZE)], [bar()], map_resolution=SIZE, filter_size=3, **options)


def overlap(image, target):
    dark, wanted = image < 0.5, target < 0.5
    return (dark & wanted).sum() / (dark | wanted).sum()


def test_copies_are_scaled_turned_and_moved(variant):
    vertices, _ = BOX
    copies = np.array([[0, 0, 0, 0, 0, 0, 2, 0], [0.1, 0.2, 0.3, 0, 0, np.sin(0.4), np.cos(0.4), np.log(0.5)],
                       [0, 0, 1, 0.6, 0.0, 0.0, 0.6, 0]])  # fmt: skip
    points = mi.Point3f(*(mi.Float(np.tile(vertices[:, c], 3)) for c in range(3)))
    placed = np.array(module._placed(mi.Float(copies.T.ravel().astype(np.float32)), points)).reshape(3, -1, 3)
    np.testing.assert_allclose(placed[0], vertices, atol=1e-6)
    turn = np.array([[np.cos(0.8), -np.sin(0.8), 0], [np.sin(0.8), np.cos(0.8), 0], [0, 0, 1]])
    np.testing.assert_allclose(placed[1], 0.5 * vertices @ turn.T + [0.1, 0.2, 0.3], atol=1e-6)
    upright = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # a quarter turn about x
    np.testing.assert_allclose(placed[2], vertices @ upright.T + [0, 0, 1], atol=1e-6)


def test_derivative_is_that_of_differences(variant):
    collection = Collection(*BOX, [shadow_view(size=SIZE)], [bar()], map_resolution=SIZE, filter_size=3)
    collection.load_state({**collection.state(), **two_copies()})
    base = two_copies()["numbers"]
    points, wanted, shadows = collection._points, collection._wanted, collection._shadows
    for number in range(16):
        direction = np.eye(16)[number]
        slopes = []
        reach = 0.06
        for middle in np.linspace(-reach, reach, 17)[1::2]:
            _, slope = module._gradient(mi.Float(base + middle * direction), points, wanted, shadows)
            slopes.append(np.array(slope) @ direction)
        losses = [module._gradient(mi.Float(base + t * direction), points, wanted, shadows)[0][0] for t in (reach, -reach)]
        assert 2 * reach * np.mean(slopes) == pytest.approx(losses[0] - losses[1], rel=0.13, abs=1e-4), number


def two_copies():
    rows = np.array([[0.3, 0.1, 0, 0, 0, 0.3, 0.9, -0.3], [-0.8, 0.2, 0, 0.1, 0.0, -0.2, 0.9, -0.6]])
    return {"numbers": rows.T.ravel(), "m": np.zeros(16), "v": np.zeros(16)}


def test_recorded_steps_double_the_copies_and_match_the_target(variant):
    collection = balls(interval=80, most=4, step_size=0.01)
    counts, losses = [], []
    for _ in range(300):
        losses.append(float(np.array(collection.step())[0]))
        counts.append(collection.count)
    assert counts[79] == 1 and counts[80] == 2 and counts[160] == 4 and counts[-1] == 4
    assert len(collection.faces) == 4 * 128 and collection.faces.max() == 4 * 66 - 1 == len(collection.vertices()) - 1
    alone = losses[79]
    assert losses[-1] < 0.4 * alone and overlap(collection.visibility()[0], collection.target(0)) > 0.85


def test_recorded_copies_part_side_by_side_and_stay_before_the_receiver(variant):
    collection = balls(interval=1, most=64)
    for _ in range(7):
        collection.step()
    assert collection.count == 64
    middles = collection.vertices().reshape(64, -1, 3).mean(1)
    assert np.abs(middles[:, 2]).max() < 1.02 and len(np.unique(middles.round(3), axis=0)) == 64
    one, two = balls(interval=1, most=2), balls(interval=1, most=2)
    one.step()
    two.step()
    two.step()
    first, second = two.vertices().reshape(2, -1, 3).mean(1)
    np.testing.assert_allclose(0.5 * (first + second), one.vertices().mean(0), atol=0.03)
    assert np.linalg.norm((first - second)[:2]) == pytest.approx(2 * 0.35 * 0.7, rel=0.1)
    size = [np.ptp(points, axis=0).max() for points in (one.vertices(), two.vertices()[:66])]
    assert size[1] == pytest.approx(0.8 * size[0], rel=0.03)


def test_recorded_state_goes_on_exactly_with_all_copies(variant):
    first, second = balls(interval=4, most=2), balls(interval=4, most=2)
    for _ in range(6):
        first.step()
    second.load_state(first.state())
    assert second.count == 2
    for _ in range(3):
        assert float(np.array(first.step())[0]) == pytest.approx(float(np.array(second.step())[0]), rel=1e-4)
    np.testing.assert_allclose(first.vertices(), second.vertices(), atol=1e-4)
    first.reset()
    assert first.count == 1 and np.linalg.norm(first.vertices(), axis=1).max() == pytest.approx(0.7, rel=1e-3)


def test_collections_refuse_what_they_cannot_use(variant):
    for options in (
        {"interval": 0},
        {"most": 0},
        {"step_size": 0},
        {"seed": -1},
        {"most": "x"},
        {"step_size": None},
        {"interval": 1.5},
    ):
        with pytest.raises(ShadowmapError):
            balls(**options)
    with pytest.raises(ShadowmapError, match="targets"):
        Collection(*BOX, [shadow_view(size=SIZE)], [])
    vertices, faces = BOX
    for mesh in (
        (vertices[:, :2], faces),
        (vertices, faces.ravel()),
        (vertices, faces + 8),
        (vertices, None),
        ("box", faces),
        (3, 4),
    ):
        with pytest.raises(ShadowmapError):
            Collection(*mesh, [shadow_view(size=SIZE)], [bar()])
    collection = balls()
    with pytest.raises(ShadowmapError, match="a state of 3"):
        collection.load_state({name: np.zeros(3) for name in ("numbers", "m", "v", "t", "steps")})

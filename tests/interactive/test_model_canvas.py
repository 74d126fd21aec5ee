"""Painting: strokes, images, and undoing them."""

from __future__ import annotations

import numpy as np
import pytest

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.interactive import Canvas
from shadowmap_dr.interactive.canvas import HISTORY

H, W = 24, 32


def lit():
    return Canvas(np.ones((H, W)))


def brute_force(points, radius):
    """Coverage of a round-ended line, pixel by pixel, from the nearest of many points on it."""
    y, x = np.mgrid[:H, :W] + 0.5
    distance = np.full((H, W), np.inf)
    for a, b in zip(points, points[1:] + points[-1:], strict=True):
        for t in np.linspace(0, 1, 400):
            p = (1 - t) * np.array(a) + t * np.array(b)
            distance = np.minimum(distance, np.hypot(x - p[0], y - p[1]))
    return np.clip(radius + 0.5 - distance, 0, 1)


@pytest.mark.parametrize("points", [[(10.5, 7.0)], [(4, 4), (20, 9), (15, 21)], [(-9, 3), (5, 40)], [(30, 12), (30, 12)]])
def test_strokes_cover_what_is_near_their_line(points):
    canvas = lit()
    canvas.stroke("a", "add", 3.2, points)
    np.testing.assert_allclose(canvas.target(), 1 - brute_force(points, 3.2), atol=0.01)
    dark = Canvas(np.zeros((H, W)))
    dark.stroke("a", "erase", 3.2, points)
    np.testing.assert_allclose(dark.target(), brute_force(points, 3.2), atol=0.01)


def test_strokes_in_parts_are_one():
    whole, parts = lit(), lit()
    whole.stroke("a", "add", 2.5, [(4, 4), (20, 9), (15, 21)])
    for points in ([(4, 4)], [(4, 4), (20, 9)], [(20, 9), (15, 21)]):
        parts.stroke("a", "add", 2.5, points)
    np.testing.assert_array_equal(parts.pixels(), whole.pixels())
    assert parts.version == 3 and parts.undo() and not parts.can_undo
    assert (parts.pixels() == 255).all()


def test_of_two_strokes_at_once_one_can_be_undone():
    canvas, alone = lit(), lit()
    canvas.stroke("a", "add", 3, [(5, 5)])
    canvas.stroke("b", "add", 3, [(25, 5)])
    canvas.stroke("a", "add", 3, [(5, 5), (5, 20)])
    canvas.stroke("b", "add", 3, [(25, 5), (25, 20)])
    alone.stroke("a", "add", 3, [(5, 5), (5, 20)])
    both = canvas.target()
    canvas.undo()
    np.testing.assert_array_equal(canvas.pixels(), alone.pixels())
    canvas.redo()
    np.testing.assert_array_equal(canvas.target(), both)
    canvas.undo()
    canvas.stroke("c", "add", 2, [(16, 12)])
    assert not canvas.can_redo and not canvas.redo()


def test_images_and_clearing_can_be_undone():
    canvas = Canvas(np.full((H, W), 0.4))
    ramp = np.linspace(0, 1, W) * np.ones((H, 1))
    canvas.stroke("a", "erase", 4, [(8, 8)])
    painted = canvas.target()
    canvas.replace(ramp)
    np.testing.assert_allclose(canvas.target(), ramp, atol=0.002)
    canvas.clear()
    np.testing.assert_allclose(canvas.target(), 0.4, atol=0.002)
    canvas.undo()
    canvas.undo()
    np.testing.assert_array_equal(canvas.target(), painted)


def test_history_ends_but_what_was_painted_stays():
    canvas = lit()
    for k in range(HISTORY + 5):
        canvas.stroke(k, "add", 1, [(k % W, k // W)])
    image = canvas.target()
    undone = 0
    while canvas.undo():
        undone += 1
    assert undone == HISTORY and (canvas.target() < 1).sum() > 0
    first = lit()
    for k in range(5):
        first.stroke(k, "add", 1, [(k % W, k // W)])
    np.testing.assert_array_equal(canvas.pixels(), first.pixels())
    while canvas.redo():
        pass
    np.testing.assert_array_equal(canvas.target(), image)


def test_canvases_refuse_what_makes_no_sense():
    canvas = lit()
    for arguments in (("a", "smear", 2, [(1, 1)]), ("a", "add", 0, [(1, 1)]), ("a", "add", np.inf, [(1, 1)]),
                      ("a", "add", 2, []), ("a", "add", 2, [(np.nan, 1)])):  # fmt: skip
        with pytest.raises(ShadowmapError):
            canvas.stroke(*arguments)
    for image in (np.ones((W, H)), np.full((H, W), np.nan)):
        with pytest.raises(ShadowmapError):
            canvas.replace(image)
    assert canvas.version == 0 and not canvas.can_undo

"""Painting: strokes, images, and undoing them."""

from __future__ import annotations

import numpy as np
import pytest

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.interactive import Canvas, brush
from shadowmap_dr.interactive import canvas as canvas_module
from shadowmap_dr.interactive.canvas import HISTORY, Change

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


class DrawnAgain:
    """A canvas that draws all strokes again after each change, from the formulas, over the whole image."""

    def __init__(self, start):
        self.start = np.rint(255 * start).astype(np.uint8)
        self.edits, self.undone = [], []

    def stroke(self, key, mode, radius, points):
        same = [edit for edit in self.edits if edit[0] == key]
        if not same:
            self.edits.append((key, mode, []))
            same = self.edits[-1:]
        same[0][2].extend((a, b, radius) for a, b in zip(points, points[1:] or points, strict=False))
        self.undone.clear()

    def replace(self, image):
        self.edits.append((None, np.rint(255 * image.astype(np.float32)).astype(np.uint8), None))
        self.undone.clear()

    def undo(self):
        if self.edits:
            self.undone.append(self.edits.pop())

    def redo(self):
        if self.undone:
            self.edits.append(self.undone.pop())

    def pixels(self):
        image = self.start
        for _, tone, segments in self.edits:
            image = tone if segments is None else self.over(image, 0 if tone == "add" else 255, segments)
        return image

    @staticmethod
    def over(image, tone, segments):
        coverage = np.zeros(image.shape)
        for a, b, radius in segments:
            x, y = np.arange(W) + 0.5 - a[0], (np.arange(H) + 0.5 - a[1])[:, None]
            along = np.subtract(b, a)
            length = along @ along
            t = np.clip((x * along[0] + y * along[1]) / length, 0, 1) if length > 0 else 0.0
            distance = np.hypot(x - t * along[0], y - t * along[1])
            coverage = np.maximum(coverage, np.rint(255 * np.clip(radius + 0.5 - distance, 0, 1)))
        return (image + np.rint((tone - image.astype(float)) * coverage / 255)).astype(np.uint8)


@pytest.mark.parametrize("seed", range(8))
def test_all_edits_in_any_order_look_as_if_drawn_again(seed):
    random = np.random.default_rng(seed)
    start = random.uniform(0, 1, (H, W)).astype(np.float32)
    canvas, again = Canvas(start), DrawnAgain(start)
    np.testing.assert_array_equal(canvas.pixels(), again.pixels())
    shown = [canvas.pixels().copy()]
    for _ in range(45):
        kind = random.choice(["stroke", "stroke", "stroke", "undo", "redo", "replace"], p=[0.2, 0.2, 0.2, 0.2, 0.15, 0.05])
        if kind == "stroke":
            count = random.integers(1, 4)
            points = [tuple(p) for p in random.uniform(-8, 40, (count, 2)).round(2)]
            arguments = int(random.integers(6)), random.choice(["add", "erase"]), float(random.uniform(0.5, 9)), points
            if any(edit[0] == arguments[0] and edit[1] != arguments[1] for edit in again.edits):
                continue
            for one in (canvas, again):
                one.stroke(*arguments)
        elif kind == "replace":
            picture = random.uniform(0, 1, (H, W))
            for one in (canvas, again):
                one.replace(picture)
        else:
            for one in (canvas, again):
                getattr(one, kind)()
        np.testing.assert_array_equal(canvas.pixels(), again.pixels())
        shown.append(canvas.pixels().copy())
    assert len({image.tobytes() for image in shown}) > 10


def test_strokes_draw_only_what_they_touch(monkeypatch):
    canvas = Canvas(np.ones((256, 256)))
    for k in range(HISTORY + 10):
        canvas.stroke(k, "add", 5, [(100, 100), (150, 120)])
    drawn = []
    over = canvas_module._Edit.over
    monkeypatch.setattr(
        canvas_module._Edit, "over", lambda self, below, box: (drawn.append(below.size), over(self, below, box))[1]
    )
    canvas.stroke("new", "erase", 3, [(50, 50), (55, 50)])
    assert sum(drawn) < 200
    canvas.undo()
    assert sum(drawn) < 200


def test_changes_tell_whether_the_canvas_is_as_it_was():
    canvas = lit()
    first, second = canvas.stroke("a", "add", 3, [(5, 5)]), canvas.stroke("b", "add", 3, [(25, 5)])
    assert canvas.stroke("b", "add", 3, [(25, 8)]) is None and None is not first != second is not None
    assert canvas.undo() == Change(second, True) and canvas.redo() == Change(second, True)
    canvas.stroke("a", "add", 3, [(5, 8)])  # below the other one
    assert canvas.undo() == Change(second, False) and canvas.redo() == Change(second, True)
    assert canvas.undo() == Change(second, True) and canvas.undo() == Change(first, True) and canvas.undo() is None


def test_parts_of_lines_are_small_and_cover_the_same():
    random = np.random.default_rng(3)
    line = random.uniform(-100, 356, (512, 2))
    parts = list(brush.parts(line, 60.0, (256, 256)))
    whole, pieces = np.zeros((2, 256, 256), np.uint8)
    brush.cover(whole, line[:40], 60.0)
    for part in brush.parts(line[:40], 60.0, (256, 256)):
        brush.cover(pieces, part, 60.0)
    np.testing.assert_array_equal(whole, pieces)
    assert len(parts) > 20 and max(len(part) for part in parts) < 40
    assert all((one[-1] == other[0]).all() for one, other in zip(parts, parts[1:], strict=False))
    (one,) = brush.parts(np.zeros((1, 2)), 3.0, (256, 256))
    assert one.shape == (1, 2)

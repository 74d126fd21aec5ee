"""Triangles of polygons with notches and holes, and the files that have such."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.io.meshes import read_placed_mesh
from shadowmap_dr.io.obj import split_concave_faces
from shadowmap_dr.io.polygons import concave, ears, triangles

# An L of area 3, whose fan from the first corner covers the notch.
L_SHAPE = np.array([[0, 2, 0], [0, 0, 0], [2, 0, 0], [2, 1, 0], [1, 1, 0], [1, 2, 0]], np.float64)
ARROW = np.array([[0, 0, 0], [2, 2, 0], [0, 1, 0], [-2, 2, 0]], np.float64)[[1, 2, 3, 0]]


def ring(corners: int = 12) -> np.ndarray:
    """A ring of radii 1 and 2: the outline, and the hole's, joined by a line that is followed twice."""
    turn = np.linspace(0, 2 * np.pi, corners + 1)
    circle = np.stack([np.cos(turn), np.sin(turn), 0 * turn], -1)
    return np.concatenate([2 * circle, circle[::-1]])


def area(points: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (points[faces[:, k]] for k in range(3))
    return float(np.linalg.norm(0.5 * np.cross(b - a, c - a), axis=-1).sum())


@pytest.mark.parametrize("points", [L_SHAPE, ARROW, ring(), L_SHAPE[::-1]], ids=["L", "arrow", "ring", "clockwise"])
def test_ears_cover_a_polygon_once(points: np.ndarray) -> None:
    spokes = points - points[0]
    expected = 0.5 * np.linalg.norm(np.cross(spokes[:-1], spokes[1:]).sum(0))
    turned = points @ np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0] + [3, -2, 5]
    assert concave(turned[None])[0]
    assert area(turned, ears(turned)) == pytest.approx(expected, rel=1e-6)


def test_convex_polygons_stay_fans() -> None:
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float64)
    np.testing.assert_array_equal(triangles(square, [[0, 1, 2, 3], [0, 1]]), [[0, 1, 2], [0, 2, 3]])
    assert triangles(square, []).shape == (0, 3)
    assert triangles(square, [[0, 1, 2, 9]]).max() == 9


def test_polygons_that_cross_themselves_end() -> None:
    star = np.array([[np.cos(k * 0.8 * np.pi), np.sin(k * 0.8 * np.pi), 0] for k in (0, 1, 2, 4, 3)])
    assert ears(star).shape[1] == 3 and ears(np.zeros((5, 3))).shape[1] == 3


@pytest.mark.parametrize("kind", ["obj", "off", "backwards"])
def test_notches_of_files_stay_open(tmp_path: Path, kind: str) -> None:
    rows = [" ".join(map(str, row)) for row in L_SHAPE]
    if kind == "off":
        content = "OFF\n6 1 0\n" + "\n".join(rows) + "\n6 0 1 2 3 4 5\n"
    else:
        face = "1 2 3 4 5 6" if kind == "obj" else "-6 -5 -4 \\\n -3 -2 -1"
        content = "\n".join(f"v {row}" for row in rows) + f"\nf {face}\n"
    path = tmp_path / ("l.off" if kind == "off" else "l.obj")
    path.write_text(content)
    vertices, faces, (middle, scale) = read_placed_mesh(path)
    assert area(vertices * scale + middle, faces.astype(np.int64)) == pytest.approx(3, rel=1e-5)


def test_other_content_of_obj_files_is_kept() -> None:
    square = b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1/1 2/2 3/3 4/4"
    assert split_concave_faces(square).splitlines() == square.splitlines()
    arrow = b"v 2 2 0\nv 0 1 0\nv -2 2 0\nv 0 0 0\nusemtl red\nf 1/5/1 2/6/1 3/7/1 4/8/1\n# end"
    found = split_concave_faces(arrow).splitlines()
    assert found[-1] == b"# end" and [line[:2] for line in found].count(b"f ") == 2
    assert {word for line in found for word in line.split() if b"/" in word} == {b"1/5/1", b"2/6/1", b"3/7/1", b"4/8/1"}
    for damaged in (b"v 0 0\nf 1 2 3 4", b"v a b c\nf 1 1 1 1 1", b"f x y z w", b""):
        assert split_concave_faces(damaged) == damaged


TRIANGLE = "{}\n3 1 0{}\n0 0 0 # first\n\n1 0 0 #2\n0 1 0\n3 0 1 2 255 0 0\n"


@pytest.mark.parametrize("keyword", ["OFF", "COFF", "# a comment\nOFF", "", "appearance { }\nSTOFF", "NOFF"])
def test_off_files_with_comments_in_lines(tmp_path: Path, keyword: str) -> None:
    path = tmp_path / "a.off"
    path.write_text(TRIANGLE.format(keyword, " # three"))
    vertices, faces, _ = read_placed_mesh(path)
    assert len(vertices) == 3 and len(faces) == 1


def test_off_files_whose_counts_follow_the_keyword(tmp_path: Path) -> None:
    path = tmp_path / "a.off"
    path.write_text("OFF3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    assert len(read_placed_mesh(path)[1]) == 1


@pytest.mark.parametrize(("content", "message"), [
    ("4OFF\n1 0 0\n0 0 0 1\n", "more than three coordinates"), ("nOFF\n4\n1 0 0\n", "more than three coordinates"),
    ("OFF BINARY\n", "export it as text"), ("OFF\n3 1 0\n0 0 0\n", "damaged: it announces 3 vertices and 1 faces"),
    ("OFF\n", "damaged"), ("OFF\n1 1 0\nx y z\n3 0 0 0\n", "damaged"), ("OFF\n-1 0 0\n", "announces -1"),
])  # fmt: skip
def test_off_files_that_cannot_be_read(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "a.off"
    path.write_text(content)
    with pytest.raises(ShadowmapError, match=message):
        read_placed_mesh(path)

"""Edges that lie exactly on borders between pixels, or pass exactly through their centres, are as good as any others."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from raster_scenes import render, topology_of

from shadowmap_dr import Renderer

SIZE = 64
PIXEL = 2 / SIZE
FACES = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
SQUARE = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
DIAMOND = np.array([[0, -1], [1, 0], [0, 1], [-1, 0]])


def growth(corners: np.ndarray, shift: tuple[float, float], forward: bool) -> float:
    """Derivative of the sum of all pixels with respect to the size of a white shape."""
    world = np.c_[corners, np.zeros(4)].astype(np.float32)
    scale = mi.Float(1)
    dr.enable_grad(scale)
    x, y = (mi.Float(world[:, k].copy()) * scale + shift[k] for k in range(2))
    clip = mi.TensorXf(dr.ravel(mi.Point4f(x, y, 0, 1)), shape=(4, 4))
    total = dr.sum(render(clip, FACES, topology_of(FACES, world), SIZE)[0])
    if forward:
        dr.forward(scale)
        return float(dr.grad(total)[0])
    dr.backward(total)
    return float(dr.grad(scale)[0])


@pytest.mark.parametrize("forward", [True, False], ids=["forward", "reverse"])
@pytest.mark.parametrize(
    "corners",
    [0.5 * SQUARE, 0.5 * DIAMOND, (0.5 + PIXEL / 2) * DIAMOND, (0.5 + PIXEL / 4) * DIAMOND],
    ids=["square on borders", "diamond through centres", "diamond through corners", "diamond a quarter aside"],
)
def test_shapes_on_the_grid_grow_as_others_do(variant: str, corners: np.ndarray, forward: bool) -> None:
    expected = growth(corners, (1e-4, 1.3e-4), forward)
    assert expected > 900
    assert growth(corners, (0, 0), forward) == pytest.approx(expected, rel=2e-3)


def test_an_edge_on_a_row_of_centres_moves_once(variant: str) -> None:
    """Also if triangles beside it are different ones for each pixel: the right half is a strip of many."""
    steps = np.linspace(-1, 1, 2 * SIZE + 1)
    left = np.c_[np.full_like(steps, PIXEL / 2), steps, np.zeros_like(steps), np.ones_like(steps)]
    right = left + [1, 0, 0, 0]
    k, n = np.arange(2 * SIZE), len(steps)
    faces = np.r_[np.c_[k, n + k, k + 1], np.c_[k + 1, n + k, n + k + 1]].astype(np.uint32)
    world = np.r_[left, right].astype(np.float32)
    for behind in (False, True):
        points, triangles = world, faces
        if behind:  # a wall of many triangles, too
            wall = (world - [1, 0, 0, 0]) * [3, 1, 1, 1] + [0, 0, 0.5, 0]
            points, triangles = np.r_[world, wall].astype(np.float32), np.r_[faces, faces + len(world)]
        move = mi.Float(0)
        dr.enable_grad(move)
        x = mi.Float(points[:, 0].copy()) + dr.select(dr.arange(mi.UInt32, len(points)) < len(world), move, 0)
        clip = mi.TensorXf(dr.ravel(mi.Point4f(x, *(mi.Float(points[:, c].copy()) for c in (1, 2, 3)))), shape=(len(points), 4))
        colours = np.r_[np.full(len(faces), 1.0), np.full(len(triangles) - len(faces), 0.25)]
        image, _ = render(clip, triangles, topology_of(triangles, points[:, :3]), SIZE, colours)
        dr.forward(move)
        # One column of pixels is swept by one pixel.
        expected = -SIZE * (SIZE / 2) * (0.75 if behind else 1)
        assert float(dr.grad(image).numpy().sum()) == pytest.approx(expected, rel=0.02)


def test_a_ridge_between_two_columns(variant: str) -> None:
    """A cube turned by 45 degrees in the middle of the image, and 1/10,000 aside."""

    def derivative(place: float) -> np.ndarray:
        to_world = mi.ScalarTransform4f().rotate([0, 0, 1], 45).scale(0.5)
        look = mi.ScalarTransform4f().look_at([place, -4, 0], [place, 0, 0], [0, 0, 1])
        film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
        scene: dict[str, Any] = {"type": "scene", "cube": {"type": "cube", "to_world": to_world}}
        scene["camera"] = {"type": "perspective", "fov": 50, "to_world": look, "film": film}
        scene["sun"] = {"type": "directional", "direction": [0.5, 1, 0]}
        renderer = Renderer.from_scene(mi.load_dict(scene), shadow_method="none")
        x = mi.Float(0)
        dr.enable_grad(x)
        moved = renderer.data.geometry.shape_positions("cube") + mi.Vector3f(1, 0, 0) * x
        image = renderer.render(vertex_positions={"cube": moved})
        dr.forward(x)
        return np.array(dr.grad(image))[:, SIZE // 2 - 2 : SIZE // 2 + 2, 0]

    beside = np.abs(derivative(1e-4)).sum()
    assert beside > 10
    assert np.abs(derivative(0)).sum() == pytest.approx(beside, rel=1e-3)

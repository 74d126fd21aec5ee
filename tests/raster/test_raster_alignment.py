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


@pytest.mark.parametrize("side", [1, -1], ids=["right edge", "left edge"])
def test_an_edge_on_a_column_of_centres_moves_once(variant: str, side: int) -> None:
    """Also if what is behind it consists of many triangles, so that all pixels beside it see different ones."""
    near = np.array([[PIXEL / 2, -1, 0, 1], [PIXEL / 2, 1, 0, 1], [-2 * side, 1, 0, 1], [-2 * side, -1, 0, 1]])
    x = np.linspace(-1, 1, 2 * SIZE + 1)
    wall = np.r_[[np.c_[x, np.full_like(x, y), np.full_like(x, 0.5), np.ones_like(x)] for y in (-1, 1)]].reshape(-1, 4)
    k, n = np.arange(2 * SIZE), len(x)
    columns = np.r_[np.c_[k, k + 1, n + k], np.c_[k + 1, n + k + 1, n + k]]
    points, faces = np.r_[near, wall].astype(np.float32), np.r_[FACES, columns + 4].astype(np.uint32)
    move = mi.Float(0)
    dr.enable_grad(move)
    coordinates = [mi.Float(points[:, c].copy()) for c in range(4)]
    coordinates[0] += dr.select(dr.arange(mi.UInt32, len(points)) < 2, move, 0)
    clip = mi.TensorXf(dr.ravel(mi.Point4f(*coordinates)), shape=points.shape)
    colours = np.where(np.arange(len(faces)) < 2, 1.0, 0.25)
    image, _ = render(clip, faces, topology_of(faces, points[:, :3]), SIZE, colours)
    dr.forward(move)
    # A column of pixels is swept by half an image's width.
    assert float(dr.grad(image).numpy().sum()) == pytest.approx(0.75 * side * SIZE * SIZE / 2, rel=0.02)


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

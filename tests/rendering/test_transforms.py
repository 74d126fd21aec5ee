"""Shapes moved as a whole: ``Renderer.render(transforms=...)`` against scenes that Mitsuba loads with the same ``to_world``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from renderer_scenes import OPTIONS, ball, build, camera, renderer_of, rest

from mitsuba_baselines import derivatives
from shadowmap_dr import Renderer, ShadowmapError

# Maps of the scene: rigid, and others that leave no right angle as it is.
MAPS: dict[str, Callable[[Any], Any]] = {
    "translation": lambda T: T().translate([0.2, -0.1, 0.1]),
    "rotation": lambda T: T().translate([0.1, 0.2, 0]) @ T().rotate([1, 1, 0], 40),
    "non-uniform scale": lambda T: T().scale([1.4, 0.6, 1.1]),
    "shear": lambda T: T().rotate([0, 0, 1], 30) @ T().scale([1.5, 0.5, 1]) @ T().rotate([1, 0, 0], 30),
}
MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])


@pytest.fixture
def renderer(variant: str) -> Renderer:
    return renderer_of()


def moved_ball(folder: Path, to_world: Any, **changes: Any) -> Renderer:
    """The scene, loaded by Mitsuba with a map of the ball."""
    ball("ball", [0, 0, 0.9]).write_ply(str(folder / "ball.ply"))
    return renderer_of(ball={"type": "ply", "filename": str(folder / "ball.ply"), "to_world": to_world}, **changes)


def assert_same(found: Any, expected: Any) -> None:
    """The maps of the scene as it was given fit a little less than those of the moved scene: shadows' edges differ in width."""
    difference = np.abs(np.array(found) - np.array(expected))
    assert difference.max() < 0.025 and difference.mean() < 1e-3, (difference.max(), difference.mean())


# ------------------------------------------------------------------------------------------------------------------- images


@pytest.mark.parametrize("name", MAPS)
def test_image_is_that_of_a_moved_scene(renderer: Renderer, tmp_path: Path, name: str) -> None:
    """Vertex normals, too: they are those of the curved surface, which no computation from the vertices finds."""
    found = renderer.render(transforms={"ball": mi.Transform4f(MAPS[name](mi.ScalarTransform4f))}).numpy()
    assert_same(found, moved_ball(tmp_path, MAPS[name](mi.ScalarTransform4f)).render())
    assert np.abs(found - renderer.render().numpy()).mean() > 5e-3  # it has moved


def test_image_is_that_of_mitsuba(variant: str, tmp_path: Path) -> None:
    to_world = MAPS["shear"](mi.ScalarTransform4f)
    renderer = Renderer.from_scene(build(lamp=None), shadow_map_resolution=256)
    scene = moved_ball(tmp_path, to_world, lamp=None).data.scene
    expected = mi.render(scene, integrator=mi.load_dict({"type": "direct"}), spp=64).numpy()
    found, at_rest = (renderer.render(transforms=map_, spp=4).numpy() for map_ in ({"ball": mi.Transform4f(to_world)}, None))
    ours, others = (np.abs(image - expected).mean() for image in (found, at_rest))
    assert ours < 1.2e-3 and others > 5 * ours, (ours, others)


@pytest.mark.parametrize("shape", ["sphere", "cube", "cylinder"])
def test_shapes_that_are_tessellated(variant: str, shape: str) -> None:
    before = mi.ScalarTransform4f().translate([0, 0, 0.9]).rotate([1, 0, 0], 20).scale(0.4)
    turn = mi.ScalarTransform4f().translate([0.2, 0, 0.1]).rotate([0, 1, 1], 35).scale(1.25)
    found = renderer_of(ball={"type": shape, "to_world": before}).render(transforms={"ball": mi.Transform4f(turn)})
    assert_same(found, renderer_of(ball={"type": shape, "to_world": turn @ before}).render())


def test_matrices_of_all_kinds(renderer: Renderer) -> None:
    turn = mi.ScalarTransform4f().translate([0.1, 0.2, 0]).rotate([1, 1, 0], 40)
    expected = renderer.render(transforms={"ball": mi.Transform4f(turn)}).numpy()
    for kind in (mi.Matrix4f(turn.matrix), np.array(turn.matrix), np.array(turn.matrix).tolist(), turn):
        np.testing.assert_allclose(renderer.render(transforms={"ball": kind}).numpy(), expected, atol=1e-6)


def test_a_map_that_mirrors_turns_a_shape_inside_out(renderer: Renderer) -> None:
    """As mirrored vertices do: the order of each triangle's corners is what tells its outer side."""
    points = rest(renderer).numpy().T
    mirrored = (points @ MIRROR[:3, :3]).ravel().astype(np.float32)
    expected = renderer.render(vertex_positions={"ball": mi.Float(mirrored)}).numpy()
    found = renderer.render(transforms={"ball": MIRROR}).numpy()
    assert_same(found, expected)
    assert np.abs(found - renderer.render().numpy()).max() > 0.1


def test_vertices_are_moved_after_they_were_replaced(renderer: Renderer) -> None:
    """In whatever order both are given, and other shapes stay."""
    scale, shift = np.diag([1.2, 0.8, 1.0, 1.0]), np.eye(4)
    shift[:3, 3] = 0.2, 0.1, 0.05
    points = rest(renderer).numpy().T
    placed = points @ scale[:3, :3]
    expected = renderer.render(vertex_positions={"ball": mi.Float((placed + shift[:3, 3]).ravel().astype(np.float32))}).numpy()
    found = renderer.render({"ball": mi.Float(placed.ravel().astype(np.float32))}, transforms={"ball": shift}).numpy()
    assert_same(found, expected)
    both = renderer.render(transforms={"floor": shift, "ball": shift}).numpy()
    assert np.abs(both - renderer.render(transforms={"ball": shift}).numpy()).max() > 0.01


def test_no_transformations(renderer: Renderer) -> None:
    at_rest = renderer.render().numpy()
    for none in (None, {}):
        np.testing.assert_array_equal(renderer.render(transforms=none).numpy(), at_rest)
    np.testing.assert_allclose(renderer.render(transforms={"ball": np.eye(4)}).numpy(), at_rest, atol=1e-5)
    np.testing.assert_array_equal(renderer.render().numpy(), at_rest)  # the renderer itself stays as it is


# -------------------------------------------------------------------------------------------------------------- derivatives


def about(centre: list[float], linear: Any) -> Any:
    there = mi.Vector3f(*centre)
    return mi.Transform4f().translate(there) @ linear @ mi.Transform4f().translate(-there)


# Ways to change the map by one number.
WAYS: dict[str, tuple[float, Callable[[Any], Any]]] = {
    "translation": (0.02, lambda t: mi.Transform4f().translate(mi.Vector3f(t, -0.4 * t, 0.3 * t))),
    "rotation": (0.02, lambda t: about([0.3, 0.2, 0], mi.Transform4f().rotate(mi.Vector3f(0.3, 1, 0.5), t * 180 / np.pi))),
    "scale": (0.02, lambda t: about([0, 0, 0.9], mi.Transform4f().scale(mi.Vector3f(1 + t, 1 - 0.5 * t, 1 + 0.7 * t)))),
}


@pytest.fixture
def block(variant: str) -> Renderer:
    """A block instead of the ball, whose turning is seen."""
    place = mi.ScalarTransform4f().translate([0, 0, 0.9]).rotate([1, 2, 0], 25).scale([0.5, 0.35, 0.45])
    return Renderer.from_scene(build(ball={"type": "cube", "to_world": place}, camera=camera(64, 64)), **OPTIONS)


@pytest.mark.parametrize("name", WAYS)
def test_derivatives_by_the_map_are_those_of_differences(block: Renderer, name: str) -> None:
    step, way = WAYS[name]

    def image(t: Any) -> Any:
        return block.render(transforms={"ball": way(t)}, spp=16)

    t = dr.opaque(mi.Float, 0)
    dr.enable_grad(t)
    attached = image(t)
    dr.forward(t, dr.ADFlag.ClearEdges)
    forward = np.array(dr.grad(attached))
    before, after = (np.array(image(dr.opaque(mi.Float, side * step))) for side in (-1, 1))
    result = derivatives.agreement(forward, (after - before) / (2 * step))
    assert result.cosine > 0.98 and abs(result.scale - 1) < 0.03, result
    # In reverse, as a scalar product with an image.
    weights = np.cos(np.arange(forward.size)).reshape(forward.shape).astype(np.float32)
    u = dr.opaque(mi.Float, 0)
    dr.enable_grad(u)
    dr.backward(dr.sum(image(u) * mi.TensorXf(weights), axis=None))
    assert dr.grad(u)[0] == pytest.approx(float((weights * forward).sum()), rel=1e-3, abs=1e-5 * float(np.abs(forward).sum()))


def test_derivatives_reach_all_numbers_of_the_matrix(block: Renderer) -> None:
    """Twelve numbers move the shape; the last row, (0, 0, 0, 1) of an affine map, does not."""
    matrix = mi.Matrix4f(mi.ScalarMatrix4f(np.eye(4).tolist()))
    dr.make_opaque(matrix)
    dr.enable_grad(matrix)
    image = block.render(transforms={"ball": matrix})
    weights = np.linspace(0, 1, image.array.numpy().size).astype(np.float32).reshape(image.shape)
    dr.backward(dr.sum(image * mi.TensorXf(weights), axis=None))
    gradient = np.array(dr.grad(matrix)).reshape(4, 4)
    assert (gradient[:3] != 0).all() and np.isfinite(gradient).all() and (gradient[3] == 0).all()


def test_frozen_function_follows_the_map(renderer: Renderer) -> None:
    """Nothing of the first call's map is baked into a recording, of the image or of its derivative."""

    def both(renderer: Renderer, t: Any, positions: Any) -> tuple[Any, Any]:
        dr.enable_grad(t)
        turn = mi.Transform4f().rotate(mi.Vector3f(0, 1, 0), 50 * t).translate(mi.Vector3f(t, 0, 0))
        image = renderer.render({"ball": positions}, transforms={"ball": turn}).array
        dr.forward_to(image, flags=dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad)
        return dr.detach(image), dr.grad(image)

    frozen, own, plain = dr.freeze(both), renderer_of(), renderer_of()
    images = []
    for k in range(4):
        positions = rest(renderer) * (1 - 0.05 * k)
        t = [mi.Float(0.1 * k) for _ in range(2)]
        for each in t:
            dr.make_opaque(each)
            dr.enable_grad(each)
            dr.set_grad(each, 1)
        found, expected = frozen(own, t[0], positions), both(plain, t[1], positions)
        for ours, theirs in zip(found, expected, strict=True):
            np.testing.assert_allclose(ours.numpy(), theirs.numpy(), atol=2e-4 * max(1, np.abs(theirs.numpy()).max()))
        images.append(found[0].numpy())
    assert frozen.n_recordings <= 3 and np.abs(images[-1] - images[0]).max() > 0.1


# ------------------------------------------------------------------------------------------------------------------- errors


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"bal": np.eye(4)}, "no shape 'bal' in the scene; its shapes are 'ball', 'floor'"),
        ({"ball": np.eye(3)}, "transforms['ball'] is a ndarray: give a Transform4f or a 4 x 4 matrix."),
        ({"ball": "left"}, "transforms['ball'] is a str: give a Transform4f or a 4 x 4 matrix."),
        ({"ball": None}, "transforms['ball'] is a NoneType: give"),
        ({"ball": 2.0}, "transforms['ball'] is a float: give"),
        ({"ball": [[1, 2], [3]]}, "transforms['ball'] is a list: give"),
        ([np.eye(4)], "transforms is a list: give a dictionary of the shapes' names."),
        (np.eye(4), "transforms is a ndarray: give a dictionary"),
    ],
)
def test_what_is_no_transformation(renderer: Renderer, given: Any, words: str) -> None:
    with pytest.raises(ShadowmapError) as raised:
        renderer.render(transforms=given)
    assert words in str(raised.value) and "\n" not in str(raised.value)


def test_several_transformations_at_once(renderer: Renderer) -> None:
    two = mi.Transform4f().translate(mi.Vector3f(mi.Float([0, 1]), 0, 0))
    with pytest.raises(ShadowmapError, match=r"transforms\['ball'\] holds 2 transformations: give one\."):
        renderer.render(transforms={"ball": two})
    for value in (mi.Point3f(1, 2, 3), mi.Float(2), mi.Matrix3f(1)):
        with pytest.raises(ShadowmapError, match=rf"transforms\['ball'\] is a {type(value).__name__}: give"):
            renderer.render(transforms={"ball": value})

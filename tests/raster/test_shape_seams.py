"""Shapes that border on each other when the scene is loaded may part later, and need not all be shown."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from integrator_scenes import image_and_derivative

from shadowmap_dr import Renderer
from shadowmap_dr.raster import build_topology, detach_moved_seams

SIZE = 64
GAP = 0.23


def scene(gap: float, x: float = 0.0, **more: Any) -> Any:
    """Two squares in one plane, side by side."""
    T = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    look = T().look_at([x, 0, 5], [x, 0, 0], [0, 1, 0])
    return mi.load_dict({
        "type": "scene",
        "camera": {"type": "perspective", "fov": 50, "to_world": look, "film": film},
        "left": {"type": "rectangle", "to_world": place(-0.8)},
        "right": {"type": "rectangle", "to_world": place(0.8 + gap), **more},
        "sun": {"type": "directional", "direction": [0, 0.1, -1]},
    }, optimize=False)  # fmt: skip


def place(x: float) -> Any:
    return mi.ScalarTransform4f().translate([x, 0.1, 0]).scale([0.8, 0.8, 1])


def moved_right(made: Any, name: str, gap: float, **options: Any) -> tuple[np.ndarray, np.ndarray]:
    return image_and_derivative(made, name, (1, 0, 0), gap, shadow_method="none", **options)


def test_shapes_that_part(variant: str) -> None:
    """Shapes that they touched when the scene was loaded do not matter."""
    expected, derivative = moved_right(scene(GAP), "right", 0)
    found, other = moved_right(scene(0), "right", GAP)
    assert np.abs(derivative).sum() > 10
    np.testing.assert_allclose(found, expected, atol=1e-5)
    np.testing.assert_allclose(other, derivative, atol=1e-3 * np.abs(derivative).max())


def test_shapes_that_part_from_a_scene_with_gradients(variant: str) -> None:
    """That was loaded while a parameter of it carried some."""
    expected, _ = moved_right(scene(GAP), "right", 0)
    made = scene(0)
    params = mi.traverse(made)
    dr.enable_grad(params["left.to_world"])
    params.update()
    found, _ = moved_right(made, "right", GAP)
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize("recorded", [False, True], ids=["plain", "recorded"])
def test_shapes_that_part_in_the_plug_in(variant: str, recorded: bool) -> None:
    made = scene(0)
    used, fresh = (mi.load_dict({"type": "shadowmap", "shadow_method": "none", "recorded": recorded}) for _ in range(2))
    for _ in range(3):
        before = np.array(mi.render(made, integrator=used))
    params = mi.traverse(made)
    params["right.to_world"] = mi.Transform4f(place(0.8 + GAP).matrix)
    params.update()
    found, expected = (np.array(mi.render(made, integrator=integrator)) for integrator in (used, fresh))
    assert np.abs(expected - before).max() > 0.1
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize("x", [0.11, -0.11])
def test_shapes_beside_hidden_lamps_end_there(variant: str, x: float) -> None:
    lamp = {"glow": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}}
    options = {"hide_emitters": True, "area_light_samples": 1}
    expected, derivative = moved_right(scene(5, x), "left", 0, **options)
    found, other = moved_right(scene(0, x, **lamp), "left", 0, **options)
    middle = slice(SIZE // 4, -SIZE // 4), slice(SIZE // 4, -SIZE // 4)
    assert np.abs(derivative[middle]).sum() > 10
    np.testing.assert_allclose(found[middle], expected[middle], atol=1e-5)
    np.testing.assert_allclose(other[middle], derivative[middle], atol=1e-3 * np.abs(derivative).max())


def test_colours_jump_between_smooth_shapes_that_border(variant: str) -> None:
    """A ball of two halves of different colour: where they meet, the image changes as they turn."""
    T = mi.ScalarTransform4f
    made = mi.load_dict({"type": "scene", "ball": {"type": "sphere"}})
    whole = Renderer.from_scene(made, tessellation=32).data.geometry
    points = np.array(whole.positions).reshape(-1, 3)
    faces = np.array(whole.faces).reshape(-1, 3)
    left = points[faces].mean(1)[:, 0] < 0
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    look = T().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]) @ T().rotate([0, 0, 1], 7)
    parts: dict[str, Any] = {"camera": {"type": "perspective", "fov": 30, "to_world": look, "film": film}}
    for name, chosen, value in (("left", left, 0.2), ("right", ~left, 0.9)):
        props = mi.Properties()
        props["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": {"type": "rgb", "value": value}})
        mesh = mi.Mesh(name, len(points), int(chosen.sum()), has_vertex_normals=True, props=props)
        params = mi.traverse(mesh)
        params["vertex_positions"], params["vertex_normals"] = points.ravel(), points.ravel()
        params["faces"] = faces[chosen].ravel()
        params.update()
        parts[name] = mesh
    made = mi.load_dict({"type": "scene", **parts, "sun": {"type": "directional", "direction": [0, 0, -1]}})
    renderer = Renderer.from_scene(made, shadow_method="none")
    plain = np.array(Renderer.from_scene(made, shadow_method="none", antialias=False).render())
    image, fine = np.array(renderer.render()), np.array(renderer.render(spp=64))
    middle = slice(SIZE // 4, -SIZE // 4)
    error, without = (np.abs(picture - fine)[middle, middle].mean() for picture in (image, plain))
    assert error < 0.5 * without


def test_seams_are_between_shapes_only() -> None:
    """Two quads with an edge in common: of one shape, of two, and of two that have parted."""
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [1, 0, 0], [2, 0, 0], [2, 1, 0], [1, 1, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    UInt32, Array3f = dr.llvm.ad.UInt32, dr.llvm.ad.Array3f
    shapes = np.repeat([0, 1], 4)
    one = build_topology(faces, points, UInt32)
    two = build_topology(faces, points, UInt32, shapes)
    assert one.seams is None and one.part_count == 1 and one.count == 9
    assert two.seams.count == 1 and two.part_count == 2 and two.count == 10

    def boundaries(topology: Any) -> set[frozenset[int]]:
        ends, thirds = (np.array(a).reshape(-1, 2) for a in (topology.edges, topology.opposite))
        single = (thirds[:, 1] == 0xFFFFFFFF) & (ends[:, 0] != ends[:, 1])
        return {frozenset(int(v) for v in e) for e in ends[single]}

    here = detach_moved_seams(two, Array3f(points.T.copy()), UInt32(shapes))
    assert boundaries(here) == boundaries(one) == boundaries(two)
    moved = detach_moved_seams(two, Array3f((points + shapes[:, None] * [0.1, 0, 0]).T.astype(np.float32)), UInt32(shapes))
    hidden = detach_moved_seams(two, Array3f(points.T.copy()), UInt32(shapes), [1])
    for other in (moved, hidden):
        assert boundaries(other) == boundaries(one) | {frozenset((1, 2)), frozenset((4, 7))}
    assert (np.array(moved.beyond) == 0xFFFFFFFF).sum() == (np.array(here.beyond) == 0xFFFFFFFF).sum() + 2

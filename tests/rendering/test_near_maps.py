"""Terrain under a sky: directions have a second map for what lies near the cameras. References are Mitsuba's, or NumPy's."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
import pytest

from mitsuba_baselines.derivatives import agreement
from shadowmap_dr import Renderer
from shadowmap_dr.rendering.extended_lights.near_maps import near_points

Array = npt.NDArray[np.float64]
SKY: dict[str, Any] = {"type": "constant", "radiance": 1.0}


def terrain(width: float, cells: int = 120) -> mi.Mesh:
    """A square of hills 0.15 high, (-width/2, width/2)^2."""
    x = np.linspace(-width / 2, width / 2, cells + 1)
    a, b = np.meshgrid(x, x, indexing="ij")
    steep = 2 if width <= 60 else 0.7
    vertices = np.stack([a, b, 0.15 * np.sin(steep * a) * np.cos(0.85 * steep * b)], -1).reshape(-1, 3)
    first = np.arange(cells * (cells + 1)).reshape(cells, cells + 1)[:, :cells].ravel()
    right, up = first + cells + 1, first + 1
    faces = np.concatenate([np.stack([first, right, right + 1], 1), np.stack([first, right + 1, up], 1)])
    mesh = mi.Mesh("terrain", len(vertices), len(faces))
    params = mi.traverse(mesh)
    params["vertex_positions"], params["faces"] = vertices.astype(np.float32).ravel(), faces.astype(np.uint32).ravel()
    params.update()
    return mesh


def view(x: float = 0, size: int = 64, **changes: Any) -> dict[str, Any]:
    """A camera that looks at what stands at (x, 0)."""
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    to_world = mi.ScalarTransform4f().look_at([x + 3, -4, 2.5], [x, 0, 0.6], [0, 0, 1])
    return {"type": "perspective", "fov": 40, "to_world": to_world, "film": film, **changes}


def landscape(width: float, *, size: int = 64, **changes: Any) -> mi.Scene:
    """A ball over a terrain, beside a box that stands on it."""
    box = mi.ScalarTransform4f().translate([1, 0.6, 0.45]).scale(0.3)
    parts = {
        "terrain": terrain(width),
        "ball": {"type": "sphere", "center": [0, 0, 0.8], "radius": 0.5},
        "box": {"type": "cube", "to_world": box},
        "camera": view(size=size),
        "sky": SKY,
        **changes,
    }
    return mi.load_dict({"type": "scene", **parts}, optimize=False)


def relative_error(image: Array, reference: Array) -> float:
    return float(np.sqrt(((image - reference) ** 2).mean() / (reference**2).mean()))


def has_near_maps(scene: mi.Scene) -> bool:
    (plan,) = Renderer.from_scene(scene).soft
    return plan.doubled


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize(("width", "before"), [(60, 0.033), (200, 0.095)])
def test_shadows_on_wide_terrain_are_those_of_mitsuba(width: float, before: float) -> None:
    """``before``: errors with one map for each direction, which showed all of the terrain."""
    scene = landscape(width)
    assert has_near_maps(scene)
    found = np.array(Renderer.from_scene(scene).render(spp=4), np.float64)
    expected = np.array(mi.render(scene, integrator=mi.load_dict({"type": "direct"}), spp=512), np.float64)
    assert relative_error(found, expected) < min(0.025, 0.8 * before)


@pytest.mark.usefixtures("variant")
def test_derivatives_in_near_maps() -> None:
    """By the place of the box, forward and reverse, against differences of images."""
    renderer = Renderer.from_scene(landscape(200, size=48))
    box = mi.Float(dr.ravel(renderer.vertices("box")))
    along = mi.Float(np.tile([1, 0, 0.2], dr.width(box) // 3).astype(np.float32))

    def image(x: mi.Float) -> mi.TensorXf:
        return renderer.render({"box": box + along * x}, spp=4)

    image(mi.Float(0))  # fits the maps
    x = mi.Float(0)
    dr.enable_grad(x)
    dr.set_grad(x, 1)
    found = dr.forward_to(image(x))
    step = 0.02
    difference = (np.array(image(mi.Float(step)), np.float64) - np.array(image(mi.Float(-step)), np.float64)) / (2 * step)
    near = agreement(np.array(found, np.float64), difference)
    assert near.cosine > 0.995 and near.scale == pytest.approx(1, abs=0.04)
    weights = mi.TensorXf(np.random.default_rng(0).normal(size=found.shape).astype(np.float32))
    y = mi.Float(0)
    dr.enable_grad(y)
    dr.backward(dr.sum(image(y) * weights, axis=None))
    assert float(dr.grad(y)[0]) == pytest.approx(float(dr.sum(found * weights, axis=None).array[0]), rel=1e-3, abs=1e-3)


@pytest.mark.usefixtures("variant")
def test_near_maps_follow_the_camera() -> None:
    """Recorded or not, images are those of an integrator that has seen no other place."""
    far = {"tower": {"type": "cube", "to_world": mi.ScalarTransform4f().translate([60, 0.6, 0.45]).scale(0.3)}}
    scene = landscape(200, **far)
    params = mi.traverse(scene)
    used = [mi.load_dict({"type": "shadowmap", "recorded": recorded}) for recorded in (False, True)]
    for x in (0.0, 60.0, 59.5, 0.0):
        params["camera.to_world"] = mi.Transform4f(view(x)["to_world"])
        params.update()
        fresh = np.array(mi.render(scene, integrator=mi.load_dict({"type": "shadowmap", "recorded": False})))
        for integrator in used:
            np.testing.assert_allclose(np.array(mi.render(scene, integrator=integrator)), fresh, atol=0.03)
        assert fresh.min() < 0.25  # below the box


@pytest.mark.usefixtures("variant")
def test_only_wide_terrain_has_near_maps() -> None:
    """Planes do not widen maps, and an orthographic camera sees everything from afar."""
    ground = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(100)}
    assert not has_near_maps(landscape(6))
    assert not has_near_maps(landscape(200, terrain=ground))
    afar = {"type": "orthographic", "to_world": view()["to_world"] @ mi.ScalarTransform4f().scale(4), "film": view()["film"]}
    assert not has_near_maps(landscape(200, camera=afar))
    lamp = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0, 3]).rotate([1, 0, 0], 180),
        "emitter": {"type": "area"},
    }
    assert not has_near_maps(landscape(200, sky=lamp))


def test_near_points_are_the_nearest(variant: str) -> None:
    """About three quarters of the valid points, whichever camera they are near to."""
    rng = np.random.default_rng(0)
    points, valid = rng.uniform(-1, 1, (1000, 3)) ** 3 * 50, rng.uniform(size=1000) < 0.7
    eyes = np.array([[5, 0, 0, 1], [-8, 3, 0, 1]], np.float64)
    distance = np.min([np.linalg.norm(points - eye[:3], axis=1) for eye in eyes], 0)
    given = mi.Point3f(points.T.astype(np.float32)), mi.Bool(valid)
    found = near_points(given, mi.Vector4f(eyes.T.astype(np.float32))).numpy()
    assert not found[~valid].any()
    assert found.sum() == pytest.approx(0.75 * valid.sum(), rel=0.1)
    assert distance[found].max() <= distance[valid & ~found].min() + 1e-3

"""Brightness of area lights near and all around, against closed forms, sums in NumPy and Mitsuba's unshadowed light."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh

from mitsuba_baselines.unshadowed import unshadowed
from shadowmap_dr import Renderer
from shadowmap_dr.rendering.extended_lights import area_samples
from shadowmap_dr.rendering.extended_lights.clusters import facet_clusters
from shadowmap_dr.rendering.extended_lights.samples import disk_irradiance

ALBEDO, RADIANCE = 0.5, 2.0


def glow() -> dict[str, Any]:
    return {"type": "area", "radiance": {"type": "rgb", "value": RADIANCE}}


def camera(half: float, origin: tuple[float, float, float] = (0.0, 0.01, 0.1), size: int = 12) -> dict[str, Any]:
    """An orthographic one that looks at the origin, z up."""
    t = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    place = t().look_at(list(origin), [0, 0, 0], [0, 0.6, 0.8]) @ t().scale([half, half, 1])
    return {"type": "orthographic", "to_world": place, "near_clip": 1e-3, "far_clip": 50.0, "film": film}


def scene_of(lamp: dict[str, Any], receiver: dict[str, Any] | None = None, view: dict[str, Any] | None = None) -> Any:
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(4)}
    bsdf = {"bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": ALBEDO}}}
    parts = {"camera": view or camera(0.05), "receiver": {**bsdf, **(receiver or floor)}, "lamp": {"emitter": glow(), **lamp}}
    return mi.load_dict({"type": "scene", **parts}, optimize=False)


def render(scene: Any, **options: Any) -> np.ndarray:
    settings = {"shadow_method": "none", "hide_emitters": True, **options}
    return np.array(Renderer.from_scene(scene, **settings).render())[..., 0]


def panel(height: float, half: tuple[float, float] = (0.5, 0.5)) -> dict[str, Any]:
    t = mi.ScalarTransform4f
    place = t().translate([0, 0, height]) @ t().rotate([1, 0, 0], 180) @ t().scale([*half, 1])
    return {"type": "rectangle", "to_world": place}


def below_rectangle(height: float, a: float, b: float) -> float:
    """Irradiance over radiance below the middle of a rectangle of half sides a and b: Howell's catalogue, B-4, four times."""
    x, y = a / height, b / height
    u, v = math.sqrt(1 + x * x), math.sqrt(1 + y * y)
    return 2 * (x / u * math.atan(y / u) + y / v * math.atan(x / v))


def around(kind: str) -> dict[str, Any]:
    turn = {"to_world": mi.ScalarTransform4f().rotate([1, 0.4, 0.2], 20)} if kind == "cube" else {}
    return {"type": kind, "flip_normals": True, **turn}


@pytest.mark.parametrize("kind", ["sphere", "cube"])
@pytest.mark.parametrize("shadows", ["none", "vsm"])
def test_ball_in_a_shining_room_is_as_bright_as_its_albedo(variant: str, kind: str, shadows: str) -> None:
    """Whatever the shape of the lamp around it."""
    ball = {"type": "sphere", "radius": 0.15}
    view = camera(0.1, (0.5, 0.1, 0.3))
    image = render(scene_of(around(kind), ball, view), shadow_method=shadows)
    assert image.mean() == pytest.approx(ALBEDO * RADIANCE, rel=0.01 if shadows == "none" else 0.02)
    np.testing.assert_allclose(image, ALBEDO * RADIANCE, rtol=0.03)


@pytest.mark.parametrize("height", [0.2, 0.5, 2.0, 10.0])
def test_below_a_rectangle(variant: str, height: float) -> None:
    """Down to a distance little more than the width of a sample's part."""
    image = render(scene_of(panel(height, (0.5, 0.3)), view=camera(0.01, (0, 0.001, 0.05))))
    expected = ALBEDO / math.pi * RADIANCE * below_rectangle(height, 0.5, 0.3)
    assert image.mean() == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("distance", [0.8, 1.5, 5.0])
def test_sphere_half_below_the_horizon(variant: str, distance: float) -> None:
    """Of which the floor sees the upper half: sigma - sin(sigma) cos(sigma) of the radiance, sigma its half-angle."""
    lamp = {"type": "sphere", "radius": 0.5, "center": [distance, 0, 0]}
    image = render(scene_of(lamp, view=camera(0.005, (0, 0.001, 0.1))))
    sigma = math.asin(0.5 / distance)
    expected = ALBEDO / math.pi * RADIANCE * (sigma - math.sin(sigma) * math.cos(sigma))
    assert image.mean() == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("kind", ["sphere", "cylinder", "cube", "disk", "photograph"])
@pytest.mark.parametrize("distance", [0.5, 2.0])
def test_ball_below_lamps_of_all_shapes(variant: str, kind: str, distance: float) -> None:
    """Against Mitsuba's unshadowed light: the mean over a ball, of which a half is turned away from the lamp or nearly so."""
    t = mi.ScalarTransform4f
    place = t().translate([0.0, 0.1, 0.3 + distance + 0.5])
    lamps: dict[str, dict[str, Any]] = {
        "sphere": {"type": "sphere", "to_world": place @ t().scale(0.5)},
        "cylinder": {"type": "cylinder", "to_world": place, "p0": [-0.5, 0, 0.2], "p1": [0.5, 0, -0.2], "radius": 0.1},
        "cube": {"type": "cube", "to_world": place @ t().rotate([1, 0.5, 0.2], 30) @ t().scale(0.3)},
        "disk": {"type": "disk", "to_world": place @ t().rotate([1, 0, 0], 165) @ t().scale(0.5)},
    }
    x, y = np.meshgrid(*2 * [np.linspace(0, 1, 128)])
    pixels = np.maximum(10 * np.exp(-((x - 0.7) ** 2 + (y - 0.3) ** 2) / 0.01), 0.01)
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(np.repeat(pixels[..., None], 3, 2).astype(np.float32)), "raw": True}
    lamps["photograph"] = {
        "type": "rectangle", "to_world": lamps["disk"]["to_world"], "emitter": {"type": "area", "radiance": bitmap},
    }  # fmt: skip
    scene = scene_of(lamps[kind], {"type": "sphere", "radius": 0.3}, camera(0.2, (2, 0.3, 0.5)))
    ours, right = render(scene), unshadowed(scene, spp=1024, hide_emitters=True).image[..., 0]
    assert ours.mean() == pytest.approx(right.mean(), rel=0.01)


@pytest.mark.parametrize("distance", [0.5, 1.0, 5.0])
def test_floor_below_an_uneven_mesh(variant: str, tmp_path: Path, distance: float) -> None:
    """A ball with waves on it, 5,120 triangles, each of which shines from the middle of its quarters in NumPy."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    waves = 1 + 0.04 * np.sin(14 * ball.vertices).sum(1)
    ball.vertices *= 0.45 * waves[:, None]
    ball.vertices[:, 2] += distance - ball.vertices[:, 2].min()
    a, b, c = np.moveaxis(ball.vertices[ball.faces], 1, 0)
    places = np.concatenate([(4 * a + b + c) / 6, (a + 4 * b + c) / 6, (a + b + 4 * c) / 6, (a + b + c) / 3])
    areas = np.tile(np.cross(b - a, c - a) / 8, (4, 1))
    squared = (places**2).sum(1)
    sent = np.maximum(-(places * areas).sum(1), 0) * np.maximum(places[:, 2], 0) / squared**2
    ball.export(tmp_path / "lamp.ply")
    lamp = {"type": "ply", "filename": str(tmp_path / "lamp.ply"), "face_normals": True}
    image = render(scene_of(lamp, view=camera(0.005)))
    assert image.mean() == pytest.approx(ALBEDO / math.pi * RADIANCE * sent.sum(), rel=0.006)


def test_rough_glass_gets_light_from_both_sides(variant: str) -> None:
    """A pane in a shining room, against Mitsuba's unshadowed light: no part of the lamp is lost at its horizon."""
    pane = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(0.5), "bsdf": {"type": "roughdielectric", "alpha": 0.5}}
    scene = scene_of(around("sphere"), pane, camera(0.05, (0.1, 0.2, 0.6)))
    # The glass is glossy: it takes many samples.
    ours, right = render(scene, area_light_samples=512), unshadowed(scene, spp=4096, hide_emitters=True).image[..., 0]
    assert ours.mean() == pytest.approx(right.mean(), rel=0.02)


def test_disk_irradiance_is_that_of_many_points(variant: str) -> None:
    """From 0.02 to 100 radii away, in all directions in front of the disk."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(64, 3))
    points[:, 2] = np.abs(points[:, 2]) + 0.05
    points *= 10 ** rng.uniform(-1, 2, (64, 1)) / np.linalg.norm(points, axis=1)[:, None]
    radius, n = 0.8, 400
    r, phi = np.meshgrid((np.arange(n) + 0.5) / n * radius, (np.arange(n) + 0.5) / n * 2 * np.pi)
    on_disk = np.stack([r * np.cos(phi), r * np.sin(phi), np.zeros_like(r)], -1).reshape(-1, 3)
    expected = []
    for point in points:
        to = on_disk - point
        squared = (to**2).sum(1)
        weights = point[2] / squared**2 * r.ravel() / r.sum()
        expected.append((to * weights[:, None]).sum(0))
    found = points_irradiance(points, radius)
    scale = np.linalg.norm(expected, axis=1)
    assert np.max(np.linalg.norm(found - np.array(expected), axis=1) / scale) < 2e-3
    # At a huge distance, in single precision.
    assert points_irradiance(np.array([[0, 0, 1e4]]), radius)[0, 2] == pytest.approx(-1e-8, rel=1e-5)


def points_irradiance(points: np.ndarray, radius: float) -> np.ndarray:
    """Of a disk around the origin that faces +z."""
    offset = mi.Vector3f(*(mi.Float(-points[:, c]) for c in range(3)))
    along, across = disk_irradiance(dr.squared_norm(offset), -offset.z, mi.Float(radius**2))
    return np.array(offset * along - mi.Vector3f(0, 0, 1) * across).T


def test_facets_keep_to_one_side_of_an_edge() -> None:
    """Two faces of an L, one cluster: its facets lie in one of them each, and none is lost."""
    rng = np.random.default_rng(0)
    points, normals = rng.uniform(0, 1, (300, 3)), np.zeros((300, 3))
    first = np.arange(300) < 100
    points[first, 0], points[~first, 1] = 0, 0
    normals[first, 0], normals[~first, 1] = 1, 1
    facet = facet_clusters(points, normals, np.ones(300), np.zeros(300, np.uint32), 4, np.ones(300))
    assert set(facet) == {0, 1, 2, 3}
    assert all(len(set(first[facet == k])) == 1 for k in range(4))


def test_clusters_with_fewer_pieces_than_facets() -> None:
    facet = facet_clusters(np.eye(3), np.eye(3), np.ones(3), np.array([0, 0, 1], np.uint32), 4, np.zeros(3))
    assert sorted(facet[:2]) == [0, 1] and facet[2] == 4


def distant(kind: str, elevation: float) -> dict[str, Any]:
    """A lamp of radius 0.28 or so, 6 away from the origin, ``elevation`` degrees above the floor; flat ones face the origin."""
    t = mi.ScalarTransform4f
    angle = math.radians(elevation)
    place = t().look_at([6 * math.cos(angle), 0, 6 * math.sin(angle)], [0, 0, 0], [0, 1, 0])
    sizes = {"sphere": 0.28, "cylinder": 0.2, "cube": 0.15, "disk": 0.28, "rectangle": 0.19}
    more = {"p0": [0, -1, 0], "p1": [0, 1, 0], "radius": 0.5} if kind == "cylinder" else {}
    return {"type": kind, "to_world": place @ t().scale(sizes[kind]), **more}


@pytest.mark.parametrize("kind", ["sphere", "cylinder", "cube", "disk", "rectangle"])
@pytest.mark.parametrize("elevation", [0.5, 3.0, 60.0])
def test_lamps_seen_from_afar(variant: str, kind: str, elevation: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """As bright, and with the same derivative by the place of what they light, as if their disks were seen as disks.

    To 0.3 % of either; where the horizon cuts the lamp, whose light is weak there, to 3 % of the light, 10 % of the derivative.
    """
    scene = scene_of(distant(kind, elevation), {"type": "rectangle"}, camera(0.5))

    def found() -> tuple[np.ndarray, float, bool]:
        renderer = Renderer.from_scene(scene, shadow_method="none", hide_emitters=True, area_light_samples=8)
        shift = mi.Float(0)
        dr.enable_grad(shift)
        floor = renderer.vertices("receiver") + mi.Vector3f(0.6, 0, -0.8) * shift
        image = renderer.render({"receiver": floor})
        dr.forward(shift)
        plan: Any = renderer.soft[0].parts
        return np.array(dr.detach(image)), float(np.array(dr.grad(image)).sum()), plan.far

    image, derivative, far = found()
    monkeypatch.setattr(area_samples, "_FAR", 0.0)
    right, expected, still_far = found()
    assert far and not still_far
    within = 0.003 if elevation > 1 else 0.03
    assert np.abs(image - right).max() < within * right.max()
    assert derivative == pytest.approx(expected, rel=within if elevation > 1 else 0.1)


# ------------------------------------------------------------------------------------------------------------- derivatives


def brightness(renderer: Renderer, rest: Any, grow: Any, rise: Any) -> Any:
    """Image under a lamp that is scaled by 1 + grow about its middle and lifted."""
    middle = mi.Point3f(*(float(np.mean(np.array(rest)[c])) for c in range(3)))
    moved = middle + (rest - middle) * (1 + grow) + mi.Vector3f(0, 0, 1) * rise
    return renderer.render(vertex_positions={"lamp": moved}).array


@pytest.mark.parametrize("lamp", ["panel", "sphere", "cube", "sphere around"])
@pytest.mark.parametrize("what", ["size", "height"])
def test_derivatives_by_size_and_height(variant: str, lamp: str, what: str) -> None:
    """Forward mode against differences, reverse against forward mode, and below a panel against the closed form."""
    t = mi.ScalarTransform4f
    shapes: dict[str, dict[str, Any]] = {
        "panel": panel(0.4),
        "sphere": {"type": "sphere", "radius": 0.4, "center": [0.2, 0.1, 0.7]},
        "cube": {"type": "cube", "to_world": t().translate([0, 0, 1]) @ t().rotate([1, 0.5, 0.2], 30) @ t().scale(0.3)},
        "sphere around": {"type": "sphere", "radius": 2.0, "center": [0.3, 0.1, 0.5], "flip_normals": True},
    }
    view = camera(0.01, (0, 0.001, 0.05)) if lamp == "panel" else camera(0.3)
    renderer = Renderer.from_scene(scene_of(shapes[lamp], view=view), shadow_method="none", hide_emitters=True)
    rest = renderer.data.geometry.shape_positions("lamp")

    def image(value: Any) -> Any:
        return brightness(renderer, rest, *((value, 0) if what == "size" else (0, value)))

    step = 0.004
    differences = (np.array(image(mi.Float(step)), np.float64) - np.array(image(mi.Float(-step)), np.float64)) / (2 * step)
    value = mi.Float(0)
    dr.enable_grad(value)
    output = image(value)
    dr.set_grad(value, 1)
    forward = np.array(dr.forward_to(output), np.float64)
    scale = np.sqrt(np.square(differences).mean())
    assert np.sqrt(np.square(forward - differences).mean()) < 0.02 * scale + 1e-3
    weight = np.random.default_rng(0).uniform(0, 1, len(forward)).astype(np.float32)
    value = mi.Float(0)
    dr.enable_grad(value)
    dr.backward(dr.sum(image(value) * mi.Float(weight)))
    product = weight * forward
    assert abs(float(dr.grad(value)[0]) - product.sum()) < 1e-3 * np.abs(product).sum()
    if lamp == "panel":
        e = lambda grow, rise: below_rectangle(0.4 + rise, 0.5 * (1 + grow), 0.5 * (1 + grow))  # noqa: E731
        ends = [e(s, 0) if what == "size" else e(0, s) for s in (-1e-3, 1e-3)]
        assert forward.mean() == pytest.approx(ALBEDO / math.pi * RADIANCE * (ends[1] - ends[0]) / 2e-3, rel=0.02)


@pytest.mark.parametrize("lamp", ["on the floor", "cube on the floor", "sphere on the floor", "edge-on", "without area"])
def test_touching_and_degenerate_lamps_are_finite(variant: str, lamp: str) -> None:
    """Images and derivatives where receivers touch a lamp, lie in its plane, or the lamp has no area; those are bounded."""
    t = mi.ScalarTransform4f
    shapes: dict[str, dict[str, Any]] = {
        "on the floor": panel(0.0),
        "cube on the floor": {"type": "cube", "to_world": t().translate([0, 0, 0.3]) @ t().scale(0.3)},
        "sphere on the floor": {"type": "sphere", "radius": 0.3, "center": [0, 0, 0.3]},
        "edge-on": {"type": "rectangle", "to_world": t().translate([0.5, 0, 0]) @ t().rotate([0, 1, 0], -90)},
        "without area": panel(0.5),
    }
    renderer = Renderer.from_scene(scene_of(shapes[lamp], view=camera(0.8, size=32)), shadow_method="none", hide_emitters=True)
    rest = renderer.data.geometry.shape_positions("lamp")
    shift = mi.Vector3f(0)
    dr.enable_grad(shift)
    moved = mi.Point3f(mi.Point3f(0, 0, 0.5) + 0 * (rest - mi.Point3f(0)) if lamp == "without area" else rest) + shift
    image = renderer.render(vertex_positions={"lamp": moved}).array
    dr.backward(dr.mean(image))
    gradient = np.array(dr.grad(shift))
    # Two disks overlap at most where their parts touch: twice the light of a sky of the lamp's radiance.
    assert np.isfinite(np.array(image)).all() and np.array(image).max() <= 2.01 * ALBEDO * RADIANCE
    assert np.isfinite(gradient).all() and np.abs(gradient).max() < 100

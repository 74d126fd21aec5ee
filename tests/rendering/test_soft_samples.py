"""Samples of extended lights: their sums are exact, whatever their number."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from gradients.scenes import shaded_lamp

from shadowmap_dr.rendering.extended_lights import LightSamples, plan_soft, samples_of
from shadowmap_dr.rendering.extended_lights.sample_maps import NO_SHAPE
from shadowmap_dr.scene.load import load


def scene_of(**parts: Any) -> Any:
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90) @ mi.ScalarTransform4f().scale(3)}
    return mi.load_dict({"type": "scene", "floor": floor, **parts}, optimize=False)


def samples(count: int = 16, sky: int = 16, **parts: Any) -> LightSamples:
    """Of the only extended light of a scene."""
    data = load(scene_of(**parts))
    lights = (*data.areas, *data.environments)
    (plan,) = plan_soft(lights, data.geometry, count, sky)
    return samples_of(lights[0], plan, data.geometry)


def area(*radiance: float) -> dict[str, Any]:
    return {"type": "area", "radiance": {"type": "rgb", "value": list(radiance)}}


def lamp(kind: str, emitter: Any = None) -> dict[str, Any]:
    T = mi.ScalarTransform4f
    place = T().translate([0.3, 2.0, 0.1]) @ T().rotate([1, 0, 0], 80) @ T().scale([0.6, 0.4, 0.5])
    if kind == "sphere":
        place = T().translate([0.3, 2.0, 0.1]) @ T().scale(0.5)
    return {"type": kind, "to_world": place, "emitter": emitter or area(4, 3, 2)}


AREAS = {"rectangle": 4 * 0.6 * 0.4, "disk": np.pi * 0.6 * 0.4, "sphere": 4 * np.pi * 0.25}


@pytest.mark.parametrize("count", [1, 9, 64])
@pytest.mark.parametrize("kind", AREAS)
def test_power_adds_up_to_radiance_times_area(variant: str, kind: str, count: int) -> None:
    found = samples(count, lamp=lamp(kind))
    assert found.count == count
    # Round shapes are as large as their triangles: 64 of them around lack some thousandths.
    tolerance = 1e-5 if kind == "rectangle" else 5e-3
    assert found.area.numpy().sum() == pytest.approx(AREAS[kind], rel=tolerance)
    power = np.array(found.power).sum(1)
    np.testing.assert_allclose(power, np.array([4, 3, 2]) * found.area.numpy().sum(), rtol=1e-5)
    assert found.area.numpy().min() > 0
    length = np.linalg.norm(np.array(found.normal), axis=0)
    if kind == "sphere":
        # Of caps of equal size; the whole sphere has no normal at all.
        assert length.max() <= 1 and (count == 1) == (length.mean() < 0.1) and (count < 64 or length.mean() > 0.95)
    else:
        np.testing.assert_allclose(length, 1, atol=1e-5)


@pytest.mark.parametrize("kind", AREAS)
def test_samples_lie_on_the_emitter_and_face_outwards(variant: str, kind: str) -> None:
    scene = scene_of(lamp=lamp(kind))
    found = samples(32, lamp=lamp(kind))
    normal = dr.normalize(found.normal)
    origin = mi.Point3f(found.place + 0.2 * normal)
    hit = scene.ray_intersect(mi.Ray3f(origin, -normal))
    assert dr.all(hit.emitter(scene) != None)  # noqa: E711  (compares pointers)
    np.testing.assert_allclose(hit.t.numpy(), 0.2, atol=2e-3)
    # Of round parts it is the mean of many directions.
    cosine = dr.dot(hit.n, normal).numpy()
    assert cosine.min() > (0.5 if kind == "sphere" else 0.999) and cosine.mean() > 0.97
    # No two of them in one place.
    places = np.array(found.place).T
    assert np.linalg.norm(places[:, None] - places[None], axis=-1)[~np.eye(32, dtype=bool)].min() > 0.02


@pytest.mark.parametrize("distance", [1e3, 1e5, 1e7])
def test_derivatives_of_light_from_far_away(variant: str, distance: float) -> None:
    """Irradiance falls with the squared distance, and so does its derivative; directions do not turn."""
    table = samples(4, lamp=lamp("rectangle")).table()
    rise = dr.opaque(mi.Float, distance)
    dr.enable_grad(rise)
    place = table.place(mi.UInt32(0))
    (wo, weight, reached), *_ = table.illuminate(
        mi.UInt32(0), mi.Point3f(place + mi.Vector3f(0, -1, 0) * rise), [mi.Vector3f(0, 1, 0)]
    )
    assert dr.all(reached) and weight[0][0] > 0
    dr.forward(rise, flags=dr.ADFlag.ClearInterior)
    assert dr.grad(weight)[0][0] == pytest.approx(-2 * weight[0][0] / distance, rel=1e-3)
    assert np.abs(np.array(dr.grad(wo))).max() < 1e-4 / distance


def test_power_of_a_texture_is_that_of_its_parts(variant: str) -> None:
    """Nearest texels in a plane: halves of different colours, and a dark quarter."""
    image = np.zeros((2, 2, 3), np.float32)
    image[0, 0], image[0, 1], image[1, 0] = (8, 0, 0), (0, 4, 0), (0, 0, 2)
    radiance = {"type": "bitmap", "bitmap": mi.Bitmap(image), "raw": True, "filter_type": "nearest"}
    found = samples(64, lamp=lamp("rectangle", {"type": "area", "radiance": radiance}))
    quarter = AREAS["rectangle"] / 4
    np.testing.assert_allclose(np.array(found.power).sum(1), quarter * np.array([8, 4, 2]), rtol=0.02)
    # Brighter parts have more samples.
    main = np.array(found.power).argmax(0)
    power = np.array(found.power).max(0)
    numbers = [int(((main == c) & (power > 0)).sum()) for c in range(3)]
    assert numbers[0] > numbers[1] > numbers[2] > 2


def test_radiance_with_bilinear_texture_adds_up(variant: str) -> None:
    image = np.random.default_rng(0).uniform(0, 5, (8, 8, 3)).astype(np.float32)
    radiance = {"type": "bitmap", "bitmap": mi.Bitmap(image), "raw": True, "wrap_mode": "repeat"}
    found = samples(64, lamp=lamp("rectangle", {"type": "area", "radiance": radiance}))
    np.testing.assert_allclose(np.array(found.power).sum(1), image.mean((0, 1)) * AREAS["rectangle"], rtol=0.01)


def sky_image(rows: int = 16) -> np.ndarray:
    return np.random.default_rng(1).uniform(0.1, 3.0, (rows, 2 * rows, 3)).astype(np.float32)


@pytest.mark.parametrize("count", [1, 16, 128])
def test_power_of_a_constant_sky_is_its_integral(variant: str, count: int) -> None:
    ball = {"type": "sphere", "center": [0, 1, 0], "radius": 0.5}
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [0.5, 1.0, 2.0]}}
    found = samples(sky=count, sky_=sky, ball=ball)
    assert found.distant and found.count == count
    np.testing.assert_allclose(np.array(found.power).sum(1), 4 * np.pi * np.array([0.5, 1, 2]), rtol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(np.array(found.place), axis=0), 1, atol=1e-5)
    # Most samples come from above the floor, but no light is lost.
    above = np.array(found.place)[1] < 0
    assert count < 16 or above.mean() > 0.55
    mean = (np.array(found.place) * np.array(found.power)[1]).sum(1) / (4 * np.pi)
    assert count < 128 or np.linalg.norm(mean) < 0.1


def test_sky_without_a_floor_is_sampled_from_all_sides(variant: str) -> None:
    """A wall beside a ball, with nothing below the ball: light comes from everywhere."""
    ball = {"type": "sphere", "center": [0, 5, 0], "radius": 4.0}
    found = samples(sky=64, sky_={"type": "constant"}, ball=ball)
    assert 0.4 < (np.array(found.place)[1] < 0).mean() < 0.6


@pytest.mark.parametrize("turn", [0.0, 70.0])
def test_power_of_a_map_is_its_integral(variant: str, turn: float) -> None:
    image = sky_image()
    to_world = mi.ScalarTransform4f().rotate([0.2, 1, 0.1], turn)
    found = samples(sky=32, env={"type": "envmap", "bitmap": mi.Bitmap(image), "scale": 1.5, "to_world": to_world})
    theta = np.linspace(0, np.pi, 2000, endpoint=False) + np.pi / 4000
    # Rows in between are interpolated, and the outermost go on to the poles.
    row = np.clip(theta / np.pi * 16 - 0.5, 0, 15)
    low = np.minimum(row.astype(int), 14)
    lines = image.mean(1)
    values = lines[low] * (1 - (row - low))[:, None] + lines[low + 1] * (row - low)[:, None]
    integral = (values * np.sin(theta)[:, None]).sum(0) * np.pi / 2000 * 2 * np.pi * 1.5
    np.testing.assert_allclose(np.array(found.power).sum(1), integral, rtol=0.01)


def test_samples_of_a_map_come_from_where_it_is_bright(variant: str) -> None:
    """Most of the light from one texel, in the direction in which Mitsuba sees it."""
    image = np.full((32, 64, 3), 0.01, np.float32)
    image[10, 20] = 500
    to_world = mi.ScalarTransform4f().rotate([0, 1, 0], 50)
    env = {"type": "envmap", "bitmap": mi.Bitmap(image), "to_world": to_world}
    found = samples(sky=64, env=env)
    brightest = int(np.argmax(np.array(found.power)[0]))
    towards = -np.array(found.place)[:, brightest]
    scene = scene_of(env=env)
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = -mi.Vector3f(towards)
    assert float(scene.environment().eval(si)[0][0]) > 100


def test_samples_follow_the_emitter(variant: str) -> None:
    """Attached: moved and scaled vertices move the samples, and change the power."""
    data = load(scene_of(lamp=lamp("rectangle")))
    (plan,) = plan_soft(data.areas, data.geometry, 8, 8)
    rest = data.geometry.shape_positions("lamp")
    t = mi.Float(0)
    dr.enable_grad(t)
    centre = mi.Point3f(0.3, 2.0, 0.1)
    moved = data.geometry.with_positions({"lamp": centre + (rest - centre) * (1 + t) + mi.Vector3f(0.5, 0, 0) * t})
    found = samples_of(data.areas[0], plan, moved)
    before = samples_of(data.areas[0], plan, data.geometry)
    dr.forward(t)
    expected = np.array(before.place) - np.array(centre) + np.array([[0.5], [0], [0]])
    np.testing.assert_allclose(np.array(dr.grad(found.place)), expected, atol=1e-5)
    np.testing.assert_allclose(np.array(dr.grad(found.power)), 2 * np.array(before.power), rtol=1e-4)
    np.testing.assert_allclose(np.array(dr.grad(found.normal)), 0, atol=1e-5)


@pytest.mark.parametrize("kind", ["rectangle", "disk", "sphere", "cube", "cylinder", "two boxes"])
def test_only_emitters_that_see_themselves_are_in_their_own_maps(variant: str, kind: str) -> None:
    data = load(scene_of(lamp=shaded_lamp((0, 2, 0)) if kind == "two boxes" else lamp(kind)))
    (plan,) = plan_soft(data.areas, data.geometry, 32, 32)
    info = data.geometry.shapes[data.areas[0].shape]
    if kind == "two boxes":
        assert plan.kind == "cube" and plan.facing == (info.face_start, info.face_start + info.face_count)
        assert plan.hides == NO_SHAPE
    else:
        assert plan.facing == (0, 0) and plan.hides == data.areas[0].shape

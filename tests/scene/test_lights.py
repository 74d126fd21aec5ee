"""Light records against Mitsuba's own emitter sampling."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.scene.lights.projected import Projector
from shadowmap_dr.scene.lights.punctual import DirectionalLight
from shadowmap_dr.scene.lights.read import area_lights_of, environments_of, lights_of, unsupported_reason
from shadowmap_dr.scene.load import load
from shadowmap_dr.scene.mitsuba_objects import children


def slide(rng: np.random.Generator, channels: int = 3) -> Any:
    return mi.Bitmap(mi.TensorXf(rng.random((8, 16, channels)).astype(np.float32)))


def emitters() -> dict[str, Any]:
    look_at = mi.ScalarTransform4f().look_at([-3, 2, 4], [0, 0.3, -1], [0, 1, 0])
    texture = {"type": "bitmap", "bitmap": slide(np.random.default_rng(3)), "wrap_mode": "clamp"}
    return {
        "sun": {"type": "directional", "direction": [1, 2, 3], "irradiance": {"type": "rgb", "value": [1, 2, 3]}},
        "bulb": {"type": "point", "position": [1, 2, 3], "intensity": 4.0},
        "cone": {"type": "spot", "to_world": look_at, "cutoff_angle": 35, "intensity": {"type": "rgb", "value": [3, 2, 1]}},
        "slide": {"type": "spot", "to_world": look_at, "cutoff_angle": 40, "beam_width": 10, "texture": texture},
        "wide": {"type": "spot", "to_world": look_at @ mi.ScalarTransform4f().scale(2.0), "cutoff_angle": 80},
        "beamer": {"type": "projector", "to_world": look_at, "irradiance": texture, "fov": 70, "scale": 3.0},
        "squeezed": {
            "type": "projector",
            "to_world": look_at @ mi.ScalarTransform4f().scale([2.0, 3.0, 1.5]),
            "irradiance": {"type": "rgb", "value": [1, 2, 3]},
            "fov": 50,
            "fov_axis": "y",
        },
    }


def points(count: int = 1000) -> Any:
    return mi.Point3f(np.random.default_rng(4).normal(size=(3, count)) * 2)


def sample(emitter: Any, p_world: Any) -> tuple[Any, Any]:
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(p_world))
    si.p = p_world
    ds, weight = emitter.sample_direction(si, mi.Point2f(0.5))
    return ds.d, weight


def in_rim(light: Any, p_world: Any) -> np.ndarray:
    """Mask of points where a projector's light fades, unlike Mitsuba's: a narrow strip."""
    if not isinstance(light, Projector):
        return np.zeros(dr.width(p_world), bool)
    local = mi.Transform4f(light.to_world).inverse() @ p_world
    x, y = (np.abs(0.5 * (local[k] / (local.z * light.tangents[k])).numpy()) - 0.5 for k in range(2))
    rim = np.maximum(x, y)
    assert (np.abs(rim) < light.falloff_width).mean() < 0.02
    return np.abs(rim) < light.falloff_width


@pytest.mark.parametrize("name", ["sun", "bulb", "cone", "slide", "wide", "beamer", "squeezed"])
@pytest.mark.parametrize("mono", [False, True], ids=["rgb", "mono"])
def test_equals_sample_direction(variant: str, name: str, mono: bool) -> None:
    if mono:
        variant = variant.replace("rgb", "mono")
        if variant not in mi.variants():
            pytest.skip(f"this Mitsuba has no variant {variant}")
        mi.set_variant(variant)
    scene = mi.load_dict({"type": "scene", "light": emitters()[name]})
    (light,) = lights_of(scene)
    assert light.name == "light"
    wo, weight = light.illuminate(points())
    wo_mitsuba, weight_mitsuba = sample(scene.emitters()[0], points())
    assert np.allclose(wo.numpy(), wo_mitsuba.numpy(), atol=1e-6)
    same = np.isclose(weight.numpy(), weight_mitsuba.numpy(), rtol=1e-4, atol=1e-6).all(0)
    assert np.all(same | in_rim(light, points()))
    assert weight.numpy().max() > 0
    assert np.all(light.illuminate(points(), mi.Bool(False))[1].numpy() == 0)


PARAMETERS = {
    "sun": ["irradiance.value", "to_world"],
    "bulb": ["intensity.value", "position"],
    "cone": ["intensity.value", "cutoff_angle", "beam_width", "to_world"],
    "slide": ["texture.data", "to_world"],
    "beamer": ["irradiance.data", "scale", "to_world"],
    "squeezed": ["irradiance.value", "to_world"],
}


@pytest.mark.parametrize("name,key", [(name, key) for name, keys in PARAMETERS.items() for key in keys])
def test_gradients_equal_mitsubas(variant: str, name: str, key: str) -> None:
    scene = mi.load_dict({"type": "scene", "light": emitters()[name]})
    params = mi.traverse(scene)
    start = params[f"light.{key}"]
    x = mi.Float(0.0)
    dr.enable_grad(x)
    if key == "to_world":
        turn = mi.Transform4f().rotate([0.2, 1, 0.1], 9 * x)
        params[f"light.{key}"] = mi.Transform4f().translate([0.2 * x, x, 0]) @ start @ turn
    else:
        params[f"light.{key}"] = start + (x if key == "position" else 1.5 * x)
    params.update()
    (light,) = lights_of(scene)
    usual = mi.Bool(~in_rim(light, points()))

    def gradient(wo: Any, weight: Any) -> np.ndarray:
        dr.clear_grad(x)
        total = dr.sum(dr.select(usual, dr.squared_norm(weight) + dr.dot(wo, mi.Vector3f(3, -1, 2)), 0))
        dr.backward(total, flags=dr.ADFlag.ClearInterior)
        return x.grad.numpy()

    expected = gradient(*sample(scene.emitters()[0], points()))
    assert expected[0] != 0
    assert np.allclose(gradient(*light.illuminate(points())), expected, rtol=1e-3)


def test_scaled_directional_light(variant: str) -> None:
    """Mitsuba's unit vector to it is none, and a diffuse surface so many times brighter."""
    start = mi.Transform4f().look_at([-3, 2, 4], [0, 0.3, -1], [0, 1, 0])
    scene = mi.load_dict({"type": "scene", "light": {"type": "directional", "irradiance": 2.0}})
    params, x = mi.traverse(scene), mi.Float(3.0)
    dr.enable_grad(x)
    turn = mi.Transform4f().rotate([0.6, 0.8, 0], 10 * x)
    params["light.to_world"] = start @ turn @ mi.Transform4f().scale(mi.Vector3f(1, 2, x))
    params.update()
    ours, mitsubas = lights_of(scene)[0].illuminate(points(1)), sample(scene.emitters()[0], points(1))
    assert np.isclose(dr.norm(ours[0]).numpy(), 1) and np.isclose(dr.norm(mitsubas[0]).numpy(), 3)
    found = []
    for wo, weight in (ours, mitsubas):
        value = dr.dot(wo, mi.Vector3f(1, -2, 0.5)) * weight.x
        dr.clear_grad(x)
        dr.backward(value, flags=dr.ADFlag.ClearInterior)
        found.append([value.numpy()[0], x.grad.numpy()[0]])
    assert np.allclose(*found, rtol=1e-4) and min(map(abs, found[1])) > 0.1


def test_replaced_direction_has_gradient(variant: str) -> None:
    (sun,) = lights_of(mi.load_dict({"type": "scene", "light": emitters()["sun"]}))
    x = mi.Float(0.3)
    dr.enable_grad(x)
    wo, _ = replace(sun, direction=mi.Vector3f(x, 0, -2)).illuminate(points(1))
    dr.backward(wo.x)
    length = np.hypot(0.3, 2)
    assert np.allclose(wo.numpy().ravel(), [-0.3 / length, 0, 2 / length])
    assert np.allclose(x.grad.numpy(), -4 / length**3)


@pytest.mark.parametrize("kind", ["constant", "envmap"])
def test_environment(variant: str, kind: str) -> None:
    rng = np.random.default_rng(5)
    settings = {"bitmap": slide(rng), "to_world": mi.ScalarTransform4f().rotate([1, 2, 3], 40)} if kind == "envmap" else {}
    scene = mi.load_dict({"type": "scene", "sky": {"type": kind, **settings}})
    assert lights_of(scene) == ()
    (sky,) = environments_of(scene)
    direction = dr.normalize(mi.Vector3f(rng.normal(size=(3, 100))))
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(0.0), direction))
    expected = si.emitter(scene).eval(si)
    assert np.allclose(sky.radiance(direction).numpy(), expected.numpy())


def test_projector_covers_what_mitsubas_covers(variant: str) -> None:
    """Wherever the projector stands, and however small its angle of view is."""
    for place, fov in (([0, 0, 0], 40), ([300, -200, 500], 3)):
        to_world = mi.ScalarTransform4f().look_at(place, [0, 0.1, 0.2], [0, 1, 0])
        picture = {"type": "bitmap", "bitmap": slide(np.random.default_rng(6))}
        settings = {"type": "projector", "to_world": to_world, "fov": fov, "irradiance": picture}
        (light,) = lights_of(mi.load_dict({"type": "scene", "light": settings}))
        half = np.tan(np.radians(fov / 2))
        # The picture has 16 columns and 8 rows.
        assert np.allclose(light.tangents.numpy().ravel(), [half, half / 2], rtol=1e-4)
        assert np.allclose(light.spread.numpy(), half, rtol=5e-3) and light.spread[0] > half


@pytest.mark.parametrize("kind", ["rectangle", "disk"])
@pytest.mark.parametrize("mirror", [False, True], ids=["plain", "mirrored"])
@pytest.mark.parametrize("flip", [False, True], ids=["outwards", "flipped"])
def test_beam_is_along_the_normals(variant: str, kind: str, mirror: bool, flip: bool) -> None:
    """Points in front of the shape get the radiance of Mitsuba's texture at the foot of the normal through them."""
    to_world = mi.ScalarTransform4f().look_at([1, 2, 3], [0, 0.3, -1], [0, 1, 0]) @ mi.ScalarTransform4f().scale([0.8, 0.5, 1])
    if mirror:
        to_world = to_world @ mi.ScalarTransform4f().scale([-1, 1, 1])
    texture = {"type": "bitmap", "bitmap": slide(np.random.default_rng(7)), "wrap_mode": "clamp"}
    panel = {"type": kind, "to_world": to_world, "flip_normals": flip, "glow": {"type": "directionalarea", "radiance": texture}}
    scene = mi.load_dict({"type": "scene", "panel": panel})
    (light,) = lights_of(scene)
    start = scene.shapes()[0].sample_position(0, mi.Point2f(np.random.default_rng(8).uniform(0.03, 0.97, (2, 500))))
    si = dr.zeros(mi.SurfaceInteraction3f, 500)
    si.uv = start.uv
    radiance = dict(children(scene.emitters()[0]))["radiance"].eval(si)
    wo, weight = light.illuminate(start.p + 2.5 * start.n)
    assert np.allclose(wo.numpy(), -start.n.numpy(), atol=1e-5)
    # Not in the rim.
    inside = np.abs(weight.numpy() - radiance.numpy()).max(0) < 1e-3
    assert inside.mean() > 0.93
    assert np.all(light.illuminate(start.p - 2.5 * start.n)[1].numpy() == 0)
    sideways = mi.Vector3f(light.to_world @ mi.Vector3f(1.1, 0, 0))
    assert np.all(light.illuminate(light.position + sideways + 2.5 * light.direction)[1].numpy() == 0)


def test_unsupported_emitters_are_left_out(variant: str) -> None:
    ball = {"type": "sphere", "glow": {"type": "directionalarea"}}
    scene = mi.load_dict({"type": "scene", "ball": ball, "sky": {"type": "timed_sunsky"}, "sun": emitters()["sun"]})
    assert [light.name for light in lights_of(scene)] == ["sun"]
    assert environments_of(scene) == ()
    reasons = {emitter.class_name(): unsupported_reason(emitter) for emitter in scene.emitters()}
    assert reasons["DirectionalEmitter"] is None
    assert "rectangles and disks" in reasons["DirectionalArea"] and "envmap" in reasons["TimedSunskyEmitter"]


def test_attributes_of_meshes_do_not_shine(variant: str) -> None:
    """Said in the warning about the scene, instead of a black lamp without a word."""
    glow = {"type": "area", "radiance": {"type": "mesh_attribute", "name": "vertex_color"}}
    scene = mi.load_dict({"type": "scene", "cube": {"type": "cube", "glow": glow}})
    assert area_lights_of(scene, scene.shapes()) == ()
    with pytest.warns(UserWarning, match="AreaLight. has a mesh_attribute for its radiance"):
        load(scene)


@pytest.mark.parametrize("kind", [list, np.array, lambda v: mi.ScalarVector3f(v), lambda v: mi.Vector3f(v)])
def test_parallel_light_needs_a_direction(kind: Any) -> None:
    with pytest.raises(ShadowmapError, match=r"'sun' has the direction \(0, 0, 0\)"):
        DirectionalLight("sun", kind([0.0, 0.0, 0.0]), mi.Color3f(1))
    DirectionalLight("sun", kind([0.0, 0.0, -1.0]), mi.Color3f(1))


def test_maps_look_where_lights_shine(variant: str) -> None:
    """Six faces of a cube, or one map along the axis, wide enough for the cone."""
    scene = mi.load_dict({"type": "scene", **emitters()})
    kinds = {"sun": "directional", "bulb": "cube", "cone": "spot", "slide": "spot", "wide": "cube", "beamer": "spot"}
    for light in lights_of(scene):
        kind = light.map_kind()
        assert kind == kinds.get(light.name, kind)
        views = light.map_views(kind, 64, 3)
        assert len(views) == (6 if kind == "cube" else 1)
        if kind != "cube":
            assert np.allclose(np.array(views[0].forward).ravel(), np.array(light.direction).ravel(), atol=1e-6)
        if kind == "spot":
            half_angle = np.degrees(np.arctan(float(views[0].spread[0])))
            assert half_angle >= float(getattr(light, "cutoff_angle", mi.Float(0))[0]) - 1e-3


@pytest.mark.parametrize(
    ("key", "value"),
    [*(("direction", value) for value in ([0, 0, 0], [0, 0, float("nan")], [0, 1e20, 1e20]))]
    + [*(("scale", value) for value in (1e-30, 1e30, [1, 1, 0]))],
)
def test_directional_lights_without_a_direction_are_named(variant: str, key: str, value: Any) -> None:
    place = {"to_world": mi.ScalarTransform4f().scale(value)} if key == "scale" else {key: value}
    scene = mi.load_dict({"type": "scene", "sun": {"type": "directional", **place}, "floor": {"type": "rectangle"}})
    with pytest.raises(ShadowmapError, match="light 'sun' has no direction: its direction or to_world is zero.* give three"):
        load(scene)

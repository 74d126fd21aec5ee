"""Light records against Mitsuba's own emitter sampling."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr import ShadowmapError
from shadowmap_dr.lights import environments_of, lights_of


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
    }


def points(count: int = 1000) -> Any:
    return mi.Point3f(np.random.default_rng(4).normal(size=(3, count)) * 2)


def sample(emitter: Any, p_world: Any) -> tuple[Any, Any]:
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(p_world))
    si.p = p_world
    ds, weight = emitter.sample_direction(si, mi.Point2f(0.5))
    return ds.d, weight


@pytest.mark.parametrize("name", ["sun", "bulb", "cone", "slide", "wide"])
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
    assert np.allclose(weight.numpy(), weight_mitsuba.numpy(), rtol=1e-4, atol=1e-6)
    assert weight.numpy().max() > 0
    assert np.all(light.illuminate(points(), mi.Bool(False))[1].numpy() == 0)


PARAMETERS = {
    "sun": ["irradiance.value", "to_world"],
    "bulb": ["intensity.value", "position"],
    "cone": ["intensity.value", "cutoff_angle", "beam_width", "to_world"],
    "slide": ["texture.data", "to_world"],
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

    def gradient(wo: Any, weight: Any) -> np.ndarray:
        dr.clear_grad(x)
        total = dr.sum(dr.squared_norm(weight) + dr.dot(wo, mi.Vector3f(3, -1, 2)))
        dr.backward(total, flags=dr.ADFlag.ClearInterior)
        return x.grad.numpy()

    expected = gradient(*sample(scene.emitters()[0], points()))
    assert expected[0] != 0
    assert np.allclose(gradient(*light.illuminate(points())), expected, rtol=1e-3)


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


def test_unsupported_emitters_are_named(variant: str) -> None:
    beamer = {"type": "projector", "irradiance": {"type": "bitmap", "bitmap": slide(np.random.default_rng(6))}}
    with pytest.raises(ShadowmapError, match="'beamer'.*directional, spot or point"):
        lights_of(mi.load_dict({"type": "scene", "beamer": beamer}))
    panel = {"type": "rectangle", "glow": {"type": "directionalarea"}}
    with pytest.raises(ShadowmapError, match="'panel'"):
        lights_of(mi.load_dict({"type": "scene", "panel": panel}))
    with pytest.raises(ShadowmapError, match="'sky'"):
        environments_of(mi.load_dict({"type": "scene", "sky": {"type": "sunsky"}}))

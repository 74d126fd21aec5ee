"""Results of passes that stay from one image to the next: images and derivatives are as without them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from integrator_scenes import ball, camera, floor, shadowmap, small_scene, sun

from shadowmap_dr.integrator.pass_caches import PassCaches
from shadowmap_dr.rendering.pass_cache import CacheLevel, PassCache

SIZE = 24
FEW = {
    "shadow_map_resolution": 32,
    "area_light_samples": 4,
    "environment_light_samples": 4,
    "soft_map_resolution": 32,
}
FLOOR, BALL, SUN = "floor.bsdf.reflectance.value", "ball.vertex_positions", "sun.irradiance.value"
COMMON, FIRST = (FLOOR, BALL, SUN), ("colours", "gloss")


def lamp(**emitter: Any) -> dict[str, Any]:
    place = mi.ScalarTransform4f().look_at([1, -1, 2.5], [0, 0, 0], [0, 1, 0]).scale(0.4)
    light = {"type": "area", "radiance": {"type": "rgb", "value": [6.0, 5.0, 4.0]}, **emitter}
    return {"type": "rectangle", "to_world": place, "emitter": light}


def bitmap(*shape: int) -> dict[str, Any]:
    values = np.random.default_rng(0).uniform(0.2, 0.8, shape).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True}


def coloured_ball() -> Any:
    mesh = ball()
    mesh.add_attribute("face_color", 3, np.full(3 * mesh.face_count(), 0.5, np.float32))
    mesh.set_bsdf(mi.load_dict({"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "face_color"}}))
    return mesh


def plate(bsdf: dict[str, Any]) -> dict[str, Any]:
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0.8, 0, 0.6]).scale(0.5), "bsdf": bsdf}


def spot() -> dict[str, Any]:
    to_world = mi.ScalarTransform4f().look_at([-1.5, -1, 3], [0, 0, 0.2], [0, 0, 1])
    return {"type": "spot", "cutoff_angle": 35.0, "to_world": to_world, "intensity": {"type": "rgb", "value": [8.0, 7.0, 6.0]}}


def bulb() -> dict[str, Any]:
    return {"type": "point", "position": [1.5, 0, 2.5], "intensity": {"type": "rgb", "value": 4.0}}


def grey(value: float = 0.5) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": [value, 0.4, 0.3]}}


#: Name -> (parts of the scene, parameters of the integrator, samples per pixel).
SCENES: dict[str, tuple[Callable[[], dict[str, Any]], dict[str, Any], int]] = {
    "colours": (lambda: {"floor": floor(bsdf=grey()), "spot": spot(), "bulb": bulb()}, {}, 1),
    "lamp": (lambda: {"floor": floor(bsdf=grey()), "lamp": lamp()}, {"ambient": 0.1}, 4),
    "texture": (lambda: {"floor": floor(bsdf={"type": "diffuse", "reflectance": bitmap(8, 8, 3)}), "lamp": lamp()}, {}, 1),
    "textured lamp": (lambda: {"floor": floor(bsdf=grey()), "lamp": lamp(radiance=bitmap(4, 4, 3))}, {}, 1),
    "gloss": (
        lambda: {"floor": floor(bsdf=grey()), "lamp": lamp(), "bulb": bulb(), "box": plate({"type": "roughplastic"})},
        {},
        4,
    ),
    "sky": (lambda: {"floor": floor(bsdf=grey()), "sky": {"type": "constant"}}, {}, 1),
    "gloss under a sky": (
        lambda: {"floor": floor(bsdf=grey()), "sky": {"type": "constant"}, "box": plate({"type": "roughplastic"})},
        {},
        1,
    ),
    "colours of faces": (lambda: {"ball": coloured_ball(), "floor": floor(bsdf=grey()), "lamp": lamp()}, {}, 1),
    "holes": (
        lambda: {
            "floor": floor(bsdf=grey()),
            "box": plate({"type": "mask", "opacity": bitmap(8, 8, 1), "bsdf": grey()}),
            "lamp": lamp(),
        },
        {},
        1,
    ),
    "window": (
        lambda: {
            "floor": floor(bsdf=grey()),
            "camera": camera(SIZE, crop_offset_x=4, crop_offset_y=6, crop_width=13, crop_height=11, rfilter={"type": "gaussian"}),
        },
        {"aovs": "depth,visibility"},
        1,
    ),
    "unlit": (lambda: {"floor": floor(bsdf=grey()), "lamp": lamp()}, {"hide_emitters": True, "shadow_method": "none"}, 1),
    "interleaved": (lambda: {"floor": floor(bsdf=grey()), "lamp": lamp()}, {"area_light_samples": 16}, 64),
    "interleaved on gloss": (
        lambda: {"floor": floor(bsdf=grey()), "lamp": lamp(), "box": plate({"type": "roughplastic"})},
        {"area_light_samples": 16},
        64,
    ),
    "many lights": (
        lambda: {"floor": floor(bsdf=grey()), **{f"bulb{k}": {**bulb(), "position": [k / 4, 1, 2.5]} for k in range(9)}},
        {},
        1,
    ),
}


class Pair:
    """One scene for two integrators: the one keeps results of passes, the other does not."""

    def __init__(self, parts: dict[str, Any], options: dict[str, Any], spp: int, monkeypatch: pytest.MonkeyPatch) -> None:
        self.scene = small_scene(**{"camera": camera(SIZE), "sun": sun(), **parts})
        self.integrators, self.spp = [shadowmap(**{**FEW, **options}) for _ in range(2)], spp
        self.params, self.step = mi.traverse(self.scene), 0
        self.start = {key: type(value)(value) for key, value in self.params if dr.is_array_v(value)}
        self.kept: list[PassCache] = []
        cache_for = PassCaches.cache_for

        def chosen(passes: PassCaches, *arguments: Any) -> PassCache:
            cache = cache_for(passes, *arguments)
            keeps = any(record.passes is passes for record in self.integrators[0].shell.scenes)
            self.kept += [cache] if keeps else []
            return cache if keeps else PassCache()

        monkeypatch.setattr(PassCaches, "cache_for", chosen)

    def check(self, attached: dict[str, Any]) -> None:
        """Images of both, and their derivatives by attached values, which are put into the scene."""
        found = []
        self.step += 1
        for integrator in self.integrators:
            leaves = {key: type(value)(value) for key, value in attached.items()}
            dr.enable_grad(list(leaves.values()))
            for key, value in leaves.items():
                self.params[key] = value
            self.params.update()
            image = mi.render(self.scene, self.params, integrator=integrator, spp=self.spp)
            weight = np.random.default_rng(self.step).uniform(0.5, 1.5, image.shape).astype(np.float32)
            if leaves:
                dr.backward(dr.sum(image * mi.TensorXf(weight), axis=None))
            found.append((image.numpy(), {key: np.array(dr.grad(leaf)) for key, leaf in leaves.items()}))
            for key, value in attached.items():
                self.params[key] = dr.detach(value)
            self.params.update()
        (image, gradients), (expected, others) = found
        np.testing.assert_allclose(image, expected, atol=2e-5 * max(1, np.abs(expected).max()))
        for key, gradient in others.items():
            np.testing.assert_allclose(gradients[key], gradient, atol=2e-4 * max(np.abs(gradient).max(), 1e-3), err_msg=key)


def changes(pair: Pair, rng: np.random.Generator) -> dict[str, Callable[[], Any]]:
    """New values of parameters of all kinds, for those that the scene has."""

    def colour(low: float, high: float) -> Callable[[], Any]:
        return lambda: mi.Color3f(*rng.uniform(low, high, 3).tolist())

    def grey_level(low: float, high: float) -> Callable[[], Any]:
        return lambda: mi.Float(float(rng.uniform(low, high)))

    def like(key: str) -> Callable[[], Any]:
        shape = pair.start[key].shape if key in pair.start else ()
        return lambda: mi.TensorXf(rng.uniform(0.2, 0.8, shape).astype(np.float32))

    def moved(key: str) -> Callable[[], Any]:
        start = pair.params[key] if key in pair.params else None
        return lambda: mi.Transform4f().translate(rng.uniform(-0.1, 0.1, 3).tolist()) @ mi.Transform4f(start)

    def numbers(key: str) -> Callable[[], Any]:
        return lambda: mi.Float(rng.uniform(0.2, 0.8, dr.width(pair.start[key])).astype(np.float32))

    found = {
        FLOOR: colour(0.1, 0.9),
        "box.bsdf.diffuse_reflectance.value": grey_level(0.1, 0.9),
        "floor.bsdf.reflectance.data": like("floor.bsdf.reflectance.data"),
        "ball.face_color": numbers("ball.face_color"),
        SUN: colour(1, 2),
        "spot.intensity.value": colour(4, 8),
        "bulb.intensity.value": colour(2, 4),
        "bulb0.intensity.value": colour(2, 4),
        "lamp.emitter.radiance.value": colour(3, 6),
        "lamp.emitter.radiance.data": like("lamp.emitter.radiance.data"),
        "box.bsdf.opacity.data": like("box.bsdf.opacity.data"),
        "sky.radiance.value": grey_level(0.5, 1),
        "bulb.position": lambda: mi.Point3f(*rng.uniform([1, -0.5, 2], [2, 0.5, 3]).tolist()),
        "lamp.to_world": moved("lamp.to_world"),
        "camera.to_world": moved("camera.to_world"),
        BALL: lambda: pair.start[BALL] + float(rng.uniform(-0.1, 0.1)),
    }
    return {key: value for key, value in found.items() if key in pair.params}


@pytest.mark.parametrize("name", SCENES)
def test_nothing_that_is_kept_shows(variant: str, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    parts, options, spp = SCENES[name]
    pair, rng = Pair(parts(), options, spp, monkeypatch), np.random.default_rng(3)
    values = changes(pair, rng)
    differentiable = [key for key in values if not key.endswith(("to_world", "opacity.data"))]
    for key in values:  # each kind for a while, alone
        own = key not in COMMON or name in FIRST  # values of all scenes: at length in two of them
        for attached in (key in differentiable, False, key in differentiable)[: 3 if own else 1]:
            value = values[key]()
            if attached:
                pair.check({key: value})
            else:
                pair.params[key] = value
                pair.params.update()
                pair.check({})
    for _ in range(6):  # some of them together
        chosen = [str(key) for key in rng.choice(list(values), rng.integers(0, 3), replace=False)]
        pair.check({key: values[key]() for key in chosen if key in differentiable})


def kept_after(pair: Pair, key: str, value: Callable[[], Any], count: int = 3) -> PassCache:
    for _ in range(count):
        pair.check({key: value()})
    return pair.kept[-1]


def test_what_is_kept_depends_on_what_changes(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    parts, options, spp = SCENES["colours"]
    pair, rng = Pair(parts(), options, spp, monkeypatch), np.random.default_rng(0)
    values = changes(pair, rng)
    coloured = kept_after(pair, FLOOR, values[FLOOR])
    assert coloured.level == CacheLevel.RADIANCE and coloured.lit and not coloured.lit[0].terms
    dimmed = kept_after(pair, SUN, values[SUN])
    assert dimmed.level == CacheLevel.LIGHTS and len(dimmed.lit[0].terms) == 3
    lifted = kept_after(pair, "bulb.position", values["bulb.position"])
    assert lifted.level == CacheLevel.VIEW and lifted.views and lifted.maps is None and not lifted.lit
    moved = kept_after(pair, BALL, values[BALL])
    assert moved.level == CacheLevel.NOTHING and not moved.views and moved.shapes is None


def test_images_with_other_samples_tell_what_does_not_change(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A reference with many samples, then a loop with few, whose first image keeps its passes; in turns, too."""
    parts, options, _ = SCENES["lamp"]
    pair, rng = Pair(parts(), options, 16, monkeypatch), np.random.default_rng(0)
    values = changes(pair, rng)
    pair.check({})
    assert pair.kept[-1].level == CacheLevel.NOTHING
    pair.spp = 1
    assert kept_after(pair, FLOOR, values[FLOOR], 1).level == CacheLevel.RADIANCE and pair.kept[-1].lit
    for spp, key in ((4, BALL), (16, FLOOR), (1, "lamp.emitter.radiance.value"), (1, FLOOR), (4, FLOOR), (16, BALL), (1, FLOOR)):
        pair.spp = spp
        pair.check({key: values[key]()})


def test_visibilities_are_kept_where_materials_know_directions(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    parts, options, spp = SCENES["gloss"]
    pair = Pair(parts(), options, spp, monkeypatch)
    values = changes(pair, np.random.default_rng(0))
    kept = kept_after(pair, FLOOR, values[FLOOR])
    assert len(kept.visible[0].lights) == 2 and [dr.width(part) for part in kept.visible[0].parts] == [4 * 4 * SIZE**2]


def test_large_images_keep_nothing(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shadowmap_dr.integrator.pass_caches.MOST_SAMPLES", 4 * SIZE**2)
    parts, options, _ = SCENES["colours"]
    pair = Pair(parts(), options, 4, monkeypatch)
    values = changes(pair, np.random.default_rng(0))
    assert kept_after(pair, FLOOR, values[FLOOR]).level == CacheLevel.NOTHING
    # But they tell smaller images what does not change.
    pair.spp = 1
    assert kept_after(pair, FLOOR, values[FLOOR], 1).level == CacheLevel.RADIANCE


def test_other_integrators_may_clear_the_graph(variant: str) -> None:
    """No variable of a derivative outlives it: Mitsuba's integrators fail on those when they clear the graph of another scene."""
    scene = small_scene(camera=camera(SIZE), lamp=lamp())
    params, integrator, start = mi.traverse(scene), shadowmap(**FEW), mi.Transform4f(mi.traverse(scene)["lamp.to_world"])
    for _ in range(2):
        x = mi.Float(0.1)
        dr.enable_grad(x)
        params["lamp.to_world"] = mi.Transform4f().translate([x, 0, 0]) @ start
        params.update()
        dr.forward(x, dr.ADFlag.ClearEdges)
        before = len(dr.whos_ad(True).splitlines())
        image = mi.render(scene, params, integrator=integrator)
        assert np.abs(np.array(dr.forward_to(image))).max() > 0
        del image
        assert len(dr.whos_ad(True).splitlines()) == before

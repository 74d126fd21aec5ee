"""Lights in slices: the same images and derivatives as with all shadow maps in memory at once, in less memory."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from integrator_scenes import camera, floor, shadowmap, small_scene
from translucent_scenes import scene_of as translucent_scene
from translucent_scenes import stacks

from shadowmap_dr import Renderer, ShadowmapError
from shadowmap_dr.rendering.light_slices import _groups, _Sizes

FEW = {
    "shadow_map_resolution": 32,
    "area_light_samples": 4,
    "environment_light_samples": 8,
    "soft_map_resolution": 32,
}
#: GiB: less than the maps of all lights of a scene below take, and more than those of any of its lights.
LITTLE = 0.0014


def bulb(k: int) -> dict[str, Any]:
    return {"type": "point", "position": [np.cos(k), np.sin(k), 2 + 0.1 * k], "intensity": {"type": "rgb", "value": [2, 1, 0.5]}}


def lamp(x: float, radiance: Any = 6.0) -> dict[str, Any]:
    place = mi.ScalarTransform4f().look_at([x, -1, 2.5], [0, 0, 0], [0, 1, 0]).scale(0.4)
    return {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": radiance}}


def spot(k: int) -> dict[str, Any]:
    to_world = mi.ScalarTransform4f().look_at([np.cos(k), np.sin(k), 3], [0, 0, 0.2], [0, 0, 1])
    return {"type": "spot", "cutoff_angle": 35.0, "to_world": to_world, "intensity": {"type": "rgb", "value": 3.0}}


def bitmap(*shape: int) -> dict[str, Any]:
    values = np.random.default_rng(0).uniform(0.2, 0.8, shape).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True}


def projector() -> dict[str, Any]:
    to_world = mi.ScalarTransform4f().look_at([-1, -1, 3], [0, 0, 0.2], [0, 0, 1])
    return {"type": "projector", "irradiance": bitmap(8, 8, 3), "fov": 40.0, "to_world": to_world, "scale": 20.0}


def glossy() -> dict[str, Any]:
    return {"type": "principled", "base_color": bitmap(4, 4, 3), "roughness": 0.4}


#: Parts of scenes, and the parameters whose derivatives are compared.
SCENES: dict[str, tuple[Any, list[str]]] = {
    "points and a sun": (
        lambda: {f"bulb{k}": bulb(k) for k in range(4)},
        [
            "bulb2.position",
            "bulb3.intensity.value",
            "sun.irradiance.value",
            "ball.vertex_positions",
            "floor.bsdf.reflectance.value",
        ],
    ),
    "a table of spots": (
        lambda: {f"spot{k}": spot(k) for k in range(16)},
        ["spot3.to_world", "spot11.intensity.value", "ball.vertex_positions", "camera.to_world"],
    ),
    "extended lights": (
        lambda: {"sun": None, "lamp": lamp(1, bitmap(4, 4, 3)), "second": lamp(-1), "sky": {"type": "constant", "radiance": 0.3}},
        ["lamp.to_world", "lamp.emitter.radiance.data", "second.emitter.radiance.value", "sky.radiance.value", "floor.to_world"],
    ),
    "pictures on gloss": (
        lambda: {"projector": projector(), "bulb": bulb(0), "lamp": lamp(1), "floor": floor(bsdf=glossy())},
        ["projector.irradiance.data", "floor.bsdf.base_color.data", "floor.bsdf.roughness.value", "bulb.position"],
    ),
}


class Case:
    """A scene and the derivatives of its image by several parameters."""

    def __init__(self, name: str, **options: Any) -> None:
        parts, self.keys = SCENES[name]
        self.scene = small_scene(camera=camera(24), **parts())
        self.params = mi.traverse(self.scene)
        self.integrator = shadowmap(**{**FEW, **options})
        assert all(key in self.params for key in self.keys)

    @property
    def slices(self) -> int:
        return len(self.integrator.shell.scenes[0].renderer.slices)

    def attached(self) -> list[Any]:
        for key in self.keys:
            self.params[key] = type(self.params[key])(dr.detach(self.params[key]))
            dr.enable_grad(self.params[key])
        self.params.update()
        return [self.params[key] for key in self.keys]

    def reverse(self, spp: int = 1) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        values = self.attached()
        image = mi.render(self.scene, self.params, integrator=self.integrator, spp=spp)
        weight = np.random.default_rng(1).uniform(-1, 1, image.shape).astype(np.float32)
        dr.backward(dr.sum(image * mi.TensorXf(weight), axis=None))
        gradients = [np.array(dr.grad(v.matrix if isinstance(v, mi.Transform4f) else v)) for v in values]
        return np.array(image), dict(zip(self.keys, gradients, strict=True))

    def forward(self) -> np.ndarray:
        for k, value in enumerate(self.attached()):
            leaf = value.matrix if isinstance(value, mi.Transform4f) else value
            dr.set_grad(leaf, (-1) ** k * 0.1)
        image = mi.render(self.scene, self.params, integrator=self.integrator)
        return np.array(dr.forward_to(image))


def assert_close(found: np.ndarray, expected: np.ndarray, tolerance: float = 2e-5) -> None:
    np.testing.assert_allclose(found, expected, atol=tolerance * max(np.abs(expected).max(), 1e-6))


@pytest.mark.parametrize("options", [{}, {"aovs": "visibility,depth"}, {"recorded": True}], ids=["plain", "aovs", "recorded"])
@pytest.mark.parametrize("name", SCENES)
def test_slices_do_not_show(variant: str, name: str, options: dict[str, Any]) -> None:
    whole, sliced = Case(name, **options), Case(name, light_memory=LITTLE, **options)
    for spp in (1, 1) if options else (1, 1, 4):  # the second image finds results of the first
        (image, gradients), (other, others) = whole.reverse(spp), sliced.reverse(spp)
        assert_close(other, image)
        for key, gradient in gradients.items():
            assert np.any(gradient)
            assert_close(others[key], gradient, 2e-4)
    assert whole.slices == 0 and sliced.slices >= 2


@pytest.mark.parametrize("memory", [2.0, LITTLE])
def test_derivative_by_a_material_alone(variant: str, memory: float) -> None:
    """Under points and a lamp, with nothing attached but a roughness: against a central difference of the images."""
    case = Case("pictures on gloss", light_memory=memory)
    key = "floor.bsdf.roughness.value"
    case.keys = [key]
    image, gradients = case.reverse()
    weight = np.random.default_rng(1).uniform(-1, 1, image.shape).astype(np.float32)

    def weighted(roughness: float) -> float:
        case.params[key] = mi.Float(roughness)
        case.params.update()
        return float((weight * np.array(mi.render(case.scene, integrator=case.integrator, spp=1), np.float64)).sum())

    assert float(gradients[key].ravel()[0]) == pytest.approx((weighted(0.405) - weighted(0.395)) / 0.01, rel=2e-3)


@pytest.mark.parametrize("name", SCENES)
def test_forward_mode_with_slices(variant: str, name: str) -> None:
    derivative = Case(name).forward()
    assert np.any(derivative)
    assert_close(Case(name, light_memory=LITTLE).forward(), derivative, 1e-4)


def test_frozen_steps_with_slices(variant: str) -> None:
    """A recording of the ``Renderer`` with moving lights and shapes."""
    found = []
    for memory in (2.0, LITTLE):
        scene = small_scene(camera=camera(24), **SCENES["points and a sun"][0]())
        renderer = Renderer.from_scene(scene, light_memory=memory, shadow_map_resolution=32)
        rest, start = renderer.data.geometry.shape_positions("ball"), renderer.light("bulb1")

        @dr.freeze
        def step(x: Any, renderer: Any, rest: Any, start: Any) -> Any:
            dr.enable_grad(x)
            moved = type(start)(**{**vars(start), "position": start.position + mi.Vector3f(0, x, 0)})
            image = renderer.render({"ball": rest + mi.Vector3f(x, 0, 0)}, {"bulb1": moved})
            dr.backward(dr.mean(dr.square(image), axis=None))
            return image, dr.grad(x)

        results = [step(mi.Float(x), renderer, rest, start) for x in (0.0, 0.1, -0.05, 0.2)]
        found.append([(np.array(image), float(gradient[0])) for image, gradient in results])
        assert step.n_recordings <= 2
    for (image, gradient), (other, others) in zip(*found, strict=True):
        assert_close(other, image)
        assert others == pytest.approx(gradient, rel=1e-4)


def test_groups_fit_and_are_few() -> None:
    random = np.random.default_rng(0)
    for _ in range(200):
        count = int(random.integers(1, 40))
        soft = random.random(count) < 0.3
        sizes = _Sizes(random.integers(1, 100, count).tolist(), (soft * random.integers(1, 10, count)).tolist())
        budget = int(random.integers(max(sizes.bytes(k, k + 1) for k in range(count)), 600))
        groups = _groups(sizes, budget)
        assert [first for first, _ in groups] == [0, *(last for _, last in groups[:-1])] and groups[-1][1] == count
        assert all(sizes.bytes(*group) <= budget for group in groups)
        # No group could take the next light, too, in the greedy choice of as many groups.
        least = 1
        first = 0
        for k in range(count):
            if sizes.bytes(first, k + 1) > budget:
                least, first = least + 1, k
        assert len(groups) == least


def test_equal_lights_make_equal_groups() -> None:
    groups = _groups(_Sizes([10] * 1000, [0] * 1000), 600)
    lengths = {last - first for first, last in groups[:-1]}
    assert len(groups) == 17 and lengths == {59}


def test_a_light_that_does_not_fit(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is a slice of its own if the machine has the memory, and named otherwise."""
    scene = small_scene(camera=camera(16), lamp=lamp(1), second=lamp(-1))
    renderer = Renderer.from_scene(scene, light_memory=1e-3, shadow_map_resolution=16)
    assert len(renderer.slices) == 3
    assert_close(np.array(renderer.render()), np.array(Renderer.from_scene(scene, shadow_map_resolution=16).render()))
    alone = small_scene(camera=camera(16), sun=None, lamp=lamp(1))
    assert Renderer.from_scene(alone, light_memory=1e-3, shadow_map_resolution=16).slices == ()
    monkeypatch.setattr("shadowmap_dr.rendering.light_slices.physical_memory", lambda: 2.0**20)
    message = r"light 'lamp' take [0-9.]+ GiB, more than light_memory \(0.001 GiB\) and this machine \([0-9.]+ GiB\): lower"
    with pytest.raises(ShadowmapError, match=message):
        Renderer.from_scene(scene, light_memory=1e-3, shadow_map_resolution=16)
    for wrong in (0, -1.0, float("nan"), True, "2"):
        with pytest.raises(ShadowmapError, match="light_memory is .*: give a positive number of GiB"):
            Renderer.from_scene(scene, light_memory=wrong)


def test_a_light_that_does_not_fit_with_its_translucent_layers(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Derivatives by the panes take several times as much memory as images, and layers without derivatives little."""
    renderer = Renderer.from_scene(translucent_scene(16, **stacks()["five"]), shadow_map_resolution=256)
    monkeypatch.setattr("shadowmap_dr.rendering.light_slices.physical_memory", lambda: 2.0**25)
    small = replace(renderer, settings=replace(renderer.settings, light_memory=1e-3))
    with pytest.raises(ShadowmapError, match=r"light 'light' take [0-9.]+ GiB, .*, translucent_layers or the number"):
        small.render()
    monkeypatch.setattr("shadowmap_dr.rendering.light_slices.physical_memory", lambda: 2.0**27)
    small.render()
    moved = {name: dr.unravel(mi.Point3f, dr.ravel(small.vertices(name))) for name in ("ball", "p0")}
    dr.enable_grad(moved)
    small.render({"ball": moved["ball"]})
    with pytest.raises(ShadowmapError, match=r"light 'light' take [0-9.]+ GiB"):
        small.render(moved)


PEAK = """
import quick_kernels, gc, json, sys
import shadowmap_dr, drjit as dr, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
from integrator_scenes import camera, shadowmap, small_scene
from translucent_scenes import scene_of, stacks, sun
from shadowmap_dr.experiments.common.timing import forget_peak_memory, peak_memory
bulbs = {f"bulb{k}": {"type": "point", "position": [k / 20 - 1, 1, 2.5]} for k in range(40)}
suns = {f"sun{k}": sun(0.05 * k - 0.3) for k in range(1, 8)}
moved = sys.argv[2]
if "ball" in moved:
    scene = small_scene(camera=camera(24), sun=None, **bulbs)
else:
    scene = scene_of(24, **suns, **stacks()["five"])
params = mi.traverse(scene)
integrator = shadowmap(shadow_map_resolution=int(sys.argv[3]), light_memory=float(sys.argv[1]))
def gradient():
    params[moved] = dr.detach(params[moved])
    dr.enable_grad(params[moved])
    params.update()
    dr.backward(dr.mean(mi.render(scene, params, integrator=integrator), axis=None))
    found = dr.detach(dr.grad(params[moved]))
    dr.eval(found)
    dr.sync_thread()
    return found
gradient()  # the memory of compilers, and of what is compiled, does not count
gc.collect()
dr.flush_malloc_cache()
forget_peak_memory()
before = peak_memory()
found = gradient()
print(json.dumps([(peak_memory() - before) / 2**30, float(dr.sum(dr.abs(found))[0])]))
"""


@pytest.mark.parametrize(
    "moved, resolution, least, most", [("ball.vertex_positions", 128, 0.1, 0.25), ("p0.bsdf.opacity.value", 256, 0.3, 0.5)]
)
def test_memory_is_bounded(moved: str, resolution: int, least: float, most: float) -> None:
    """Peaks of processes that render 40 point lights, 240 maps, or eight suns over panes, and derivatives."""
    found = []
    for memory in (2, least):
        folder, values = Path(__file__).resolve().parents[1] / "support", (str(memory), moved, str(resolution))
        child = [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(folder)!r})\n{PEAK}", *values]
        found.append(json.loads(subprocess.run(child, capture_output=True, text=True, check=True, timeout=300).stdout))
    (whole, expected), (sliced, gradient) = found
    assert gradient == pytest.approx(expected, rel=1e-4)
    assert sliced < most and sliced < 0.6 * whole

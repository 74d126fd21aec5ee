"""``dr.freeze`` of steps with a ``Renderer``: a replay gives what the same step gives unrecorded.

What once ended the process runs in one of its own.
"""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import recording_stress
from renderer_scenes import renderer_of

from shadowmap_dr import Renderer
from shadowmap_dr.jit.frozen import Frozen, freeze

TESTS = Path(__file__).parents[1]

UNSEEN = [
    ("floor.bsdf.reflectance.data", [np.random.default_rng(n).uniform(0.2, 0.8, (n, n, 3)).astype(np.float32) for n in (4, 8)]),
    ("floor.bsdf.reflectance.to_uv", [1.0, 2.0]),
    ("sky.data", [np.random.default_rng(n).uniform(0.2, 2, (n, 2 * n + 1, 3)).astype(np.float32) for n in (4, 8)]),
]

TEXTURES = """
import sys
import drjit as dr, numpy as np
import quick_kernels, shadowmap_dr
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
T, kind = mi.ScalarTransform4f, sys.argv[1]

def losses(frozen):
    image = {"type": "bitmap", "bitmap": mi.Bitmap(np.full((16, 16, 3), 0.5, np.float32)), "raw": True}
    bsdfs = {"diffuse": {"type": "diffuse", "reflectance": image},
             "principled": {"type": "twosided", "bsdf": {"type": "principled", "base_color": image, "roughness": 0.4}}}
    film = {"type": "hdrfilm", "width": 32, "height": 32, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    view = T().look_at(origin=[0, 3, 4], target=[0, 0, 0], up=[0, 1, 0])
    scene = mi.load_dict({"type": "scene",
        "camera": {"type": "perspective", "fov": 40, "to_world": view, "film": film},
        "floor": {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(1.5), "bsdf": bsdfs[kind]},
        "box": {"type": "cube", "to_world": T().translate([0, 0.3, 0]).scale(0.2), "bsdf": {"type": "roughplastic"}},
        "sun": {"type": "directional", "direction": [0.3, -1, -0.8]}}, optimize=False)
    params = mi.traverse(scene)
    key = next(key for key in params.keys() if key.startswith("floor.") and key.endswith(".data"))
    renderer = shadowmap_dr.Renderer.from_scene(scene, shadow_map_resolution=32)
    target, adam = 0.8 * renderer.render(), mi.ad.Adam(lr=0.02)
    adam[key] = mi.TensorXf(np.random.default_rng(1).uniform(0.2, 0.8, (16, 16, 3)).astype(np.float32))

    def step(adam, params, target, scene, renderer):
        params[key] = dr.clip(adam[key], 0, 1)
        params.update()
        loss = dr.mean(dr.square(renderer.render() - target), axis=None)
        dr.backward(loss)
        adam.step()
        return dr.detach(loss)

    step = dr.freeze(step) if frozen else step
    found = []
    for _ in range(8):
        found.append(float(step(adam, params, target, scene, renderer).array[0]))
        junk = [dr.opaque(mi.Float, 1e9, size) for size in (1, 1, 16, 32, 64)]
    return np.array(found)

plain, frozen = losses(False), losses(True)
assert plain[-1] < 0.9 * plain[0]
np.testing.assert_allclose(frozen, plain, rtol=1e-4)
"""


def run(code: str, *arguments: str) -> None:
    """Run Python code with modules of the tests at hand; fails where it fails."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(TESTS / "support"), str(TESTS.parent)])}
    done = subprocess.run([sys.executable, "-c", code, *arguments], env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.fixture
def renderer(variant: str) -> Renderer:
    return renderer_of()


@pytest.mark.parametrize("kind", ["diffuse", "principled"])
def test_textures_that_change_within_the_recorded_step(kind: str) -> None:
    run(TEXTURES, kind)


def test_random_steps() -> None:
    """Parameters of many kinds change between and within steps: replays give what unrecorded steps give."""
    run("""
import quick_kernels, shadowmap_dr
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
from recording_stress import stress
steps, recordings, wrong = stress(60, seed=3, seconds=25, few=True)
assert steps > recordings and not wrong, (steps, recordings, wrong)
""")


def test_garbage_waits_while_a_function_is_recorded(variant: str) -> None:
    seen = []

    def double(x: mi.Float) -> mi.Float:
        seen.append(gc.isenabled())
        return 2 * x

    call = freeze(double)
    gc.enable()
    assert call(mi.Float(1, 2)).numpy().tolist() == [2, 4] and call(x=mi.Float(3, 4)).numpy().tolist() == [6, 8]
    assert not any(seen) and gc.isenabled() and call.n_recordings == len(seen)


def test_all_recordings_of_the_package_are_such() -> None:
    package = TESTS.parent / "shadowmap_dr"
    texts = {path: path.read_text() for path in package.rglob("*.py") if path != package / "jit" / "frozen.py"}
    assert [str(path) for path, text in texts.items() if "dr.freeze(" in text.replace("`dr.freeze(", "")] == []


def test_what_follows_the_renderer_is_noticed(renderer: Renderer) -> None:
    """Numbers and switches that are among its own settings, too."""

    @dr.freeze
    def image(renderer: Renderer, spp: int, bright: bool) -> Any:
        return renderer.render(spp=spp) * (2 if bright else 1)

    other = replace(renderer, settings=replace(renderer.settings, antialias=not renderer.settings.antialias))
    for one in (renderer, other):
        for arguments in ((1, True), (4, True), (4, False), (1, False)):
            expected = replace(one).render(spp=arguments[0]).numpy() * (2 if arguments[1] else 1)
            np.testing.assert_allclose(image(replace(one), *arguments).numpy(), expected, atol=1e-5)


def test_which_array_is_given_twice_is_noticed(variant: str) -> None:
    one, two = (dr.opaque(mi.Float, value, 4) for value in (2, 3))
    last = Frozen(lambda both, chosen: chosen * 2)
    assert [float(last((one, two), chosen)[0]) for chosen in (one, two, one)] == [4, 6, 4]
    assert last.n_recordings == 2


@pytest.mark.parametrize(("key", "values"), UNSEEN)
def test_values_that_recordings_do_not_see(variant: str, key: str, values: list[Any]) -> None:
    """Shapes of images, and numbers that Mitsuba holds as constants: a ``Renderer`` says when they change."""
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(UNSEEN[0][1][0]), "raw": True}
    sky = {"type": "envmap", "bitmap": mi.Bitmap(np.full((4, 9, 3), 0.5, np.float32))}
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3), "bsdf": {"type": "diffuse", "reflectance": bitmap}}
    renderer = renderer_of(floor=floor, sky=sky)
    params = mi.traverse(renderer.data.scene)

    @dr.freeze
    def image(renderer: Renderer) -> Any:
        return renderer.render()

    images = []
    for value in (*values, *values):
        params[key] = mi.TensorXf(value) if isinstance(value, np.ndarray) else mi.ScalarTransform3f().scale(value)
        params.update()
        images.append(image(replace(renderer)).numpy())
        np.testing.assert_allclose(images[-1], replace(renderer).render().numpy(), atol=1e-5)
    assert np.abs(images[1] - images[0]).max() > 1e-2


def test_colours_of_vertices_are_recorded_anew(variant: str) -> None:
    """Mitsuba does not show them to Dr.Jit, whether they lie in memory or are one constant."""
    scene = recording_stress.scene(few=True)
    params, renderer = mi.traverse(scene), Renderer.from_scene(scene, shadow_map_resolution=32)
    count = len(params["ball.vertex_positions"])
    image = dr.freeze(lambda renderer: renderer.render())
    for value in (0.2, 0.5, 0.8, 0.4):
        params["ball.vertex_color"] = dr.full(mi.Float, value, count)
        params.update()
        np.testing.assert_allclose(image(replace(renderer)).numpy(), replace(renderer).render().numpy(), atol=1e-5)


def test_only_one_thread_waits_for_drjit(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two that do both help it, and lose terms of each other's sums."""
    torch = pytest.importorskip("torch")
    from shadowmap_dr.torch import Renderer as TorchRenderer
    from shadowmap_dr.torch import bridge, crossing, render

    original, turns = bridge.to_torch, []

    def free() -> bool:
        """True if another thread could have its turn now."""
        with ThreadPoolExecutor(1) as other:
            return other.submit(lambda: bridge._TURN.acquire(blocking=False) and bridge._TURN.release() is None).result()

    def to_torch(array: Any) -> Any:
        turns.append(not free())
        return original(array)

    for module in (crossing, render):
        monkeypatch.setattr(module, "to_torch", to_torch)
    renderer = TorchRenderer(renderer_of(), frozen=True)
    vertices = renderer.vertices("ball").requires_grad_()
    renderer.render({"ball": vertices}).square().mean().backward()
    with torch.no_grad():
        renderer.render({"ball": vertices})
    renderer.render()
    assert len(turns) == 5 and all(turns)


def test_threads_with_recordings() -> None:
    """Gradients of all threads are those of one, and none waits forever."""
    pytest.importorskip("torch")
    run("""
import threading, time, quick_kernels
import shadowmap_dr.torch as sdr
import mitsuba as mi, torch
mi.set_variant("llvm_ad_rgb")
from renderer_scenes import build
renderers = [sdr.Renderer.from_scene(build(), frozen=True, shadow_map_resolution=32) for _ in range(2)]
base = renderers[0].vertices("ball")

def step(k, renderer):
    offset = torch.tensor([0.01 * k, 0.0, 0.0], requires_grad=True)
    renderer.render({"ball": base + offset}).square().mean().backward()
    return offset.grad

right = {(k, i): step(k, renderer) for k in range(4) for i, renderer in enumerate(renderers)}
wrong, start = [], time.monotonic()

def work(number):
    j = number
    while time.monotonic() - start < 4:
        k, i = j % 4, j % 2
        gradient, j = step(k, renderers[i]), j + 1
        if (gradient - right[k, i]).norm() > 1e-3 * right[k, i].norm():
            wrong.append((k, i, gradient))

threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
[thread.start() for thread in threads], [thread.join() for thread in threads]
assert not wrong, wrong
""")


def test_what_frozen_functions_of_users_take_for_constant_is_named(variant: str) -> None:
    pixels = mi.Bitmap(np.random.default_rng(0).uniform(0.2, 0.8, (4, 4, 3)).astype(np.float32))
    film = {"type": "hdrfilm", "width": 16, "height": 16, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    floor = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": pixels, "raw": True}}}
    sun = {"type": "directional", "direction": [0, 0, -1]}
    view = {"type": "orthographic", "film": film, "to_world": mi.ScalarTransform4f().look_at([0, 0, 2], [0, 0, 0], [0, 1, 0])}
    scene = mi.load_dict({"type": "scene", "floor": floor, "sun": sun, "view": view})
    integrator, params = mi.load_dict({"type": "shadowmap", "shadow_map_resolution": 16}), mi.traverse(scene)

    @dr.freeze
    def frozen(scene: Any, light: Any) -> Any:
        return mi.render(scene, integrator=integrator, spp=1) * light

    mi.render(scene, integrator=integrator, spp=1)
    with pytest.warns(UserWarning, match=r"dr.freeze does not see changes of floor.*to_uv: call clear\(\)"):
        before = frozen(scene, mi.Float(1)).numpy()
    params["floor.bsdf.reflectance.to_uv"] = mi.ScalarTransform3f().translate([0.3, 0.1])
    params.update()
    frozen.clear()
    after = frozen(scene, mi.Float(1)).numpy()
    np.testing.assert_allclose(after, mi.render(scene, integrator=integrator, spp=1).numpy(), rtol=1e-5, atol=1e-6)
    assert np.abs(after - before).max() > 0.05


def test_numbers_of_materials_that_are_set_in_a_recorded_step(variant: str) -> None:
    """Values and gradients of replays, beside those of the same steps unrecorded."""
    scene = recording_stress.scene(few=True)
    params, renderer = mi.traverse(scene), Renderer.from_scene(scene, shadow_map_resolution=32)
    keys = ("box.bsdf.roughness.value", "box.bsdf.base_color.value")

    def step(renderer: Renderer, roughness: Any, colour: Any) -> Any:
        values = [roughness, colour]
        dr.enable_grad(values)
        for key, value in zip(keys, values, strict=True):
            params[key] = value
        params.update()
        image = renderer.render()
        dr.backward(dr.sum(dr.square(image), axis=None))
        return dr.detach(image), [dr.grad(value) for value in values]

    frozen = dr.freeze(step)
    for roughness in (0.3, 0.5, 0.4):
        found = []
        for function in (step, frozen):
            values = dr.opaque(mi.Float, roughness), mi.Color3f(*(dr.opaque(mi.Float, roughness * k) for k in (1, 0.5, 1.5)))
            image, gradients = function(replace(renderer), *values)
            found.append([image.numpy(), *(np.array(gradient) for gradient in gradients)])
        for right, value in zip(*found, strict=True):
            np.testing.assert_allclose(value, right, rtol=1e-3, atol=1e-4 * np.abs(right).max())
        assert np.abs(found[0][1]).min() > 0

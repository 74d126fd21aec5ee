"""``recorded="auto"``, the default: steps of loops are recorded by themselves, and nothing but their time changes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from integrator_scenes import camera, full_scene, recordings, shadowmap, small_scene, sun, weighted_step
from lit_scenes import lit_scene

from shadowmap_dr import ShadowmapError
from shadowmap_dr.integrator import scene_cache
from shadowmap_dr.integrator.options import Options
from shadowmap_dr.integrator.steady_steps import _FIRST, _RECORDINGS, _REPLAYS, SteadySteps
from shadowmap_dr.jit.gc import gc_quiet
from shadowmap_dr.rendering.renderer import Renderer

VERTICES = "ball.vertex_positions"
FEW = {"area_light_samples": 4, "environment_light_samples": 8}


def assert_same(scene: Any, integrators: tuple[Any, Any], key: str, value: Any, **arguments: Any) -> np.ndarray:
    """A step is the same with two integrators. Returns the image."""
    (image, gradient), (found, derivative) = (weighted_step(scene, one, key, value, **arguments) for one in integrators)
    np.testing.assert_allclose(found, image, atol=1e-5)
    assert np.abs(gradient).max() > 1e-3
    np.testing.assert_allclose(derivative, gradient, atol=2e-4 * np.abs(gradient).max())
    return found


def both(**options: Any) -> tuple[Any, Any]:
    return shadowmap(recorded=False, **options), shadowmap(**options)


@pytest.mark.parametrize(
    ("kind", "key"),
    [
        ("small", VERTICES),
        ("small", "camera.to_world"),
        ("small", "sun.to_world"),
        ("sky", "box.vertex_positions"),
        ("lamps", "lamp.to_world"),
        ("lamps", "bulb.position"),
    ],
)
def test_steps_are_the_same(variant: str, monkeypatch: pytest.MonkeyPatch, kind: str, key: str) -> None:
    """With each kind of parameter; from the fifth step on there are recordings, and in the end nothing else is rendered."""
    scene = small_scene() if kind == "small" else lit_scene(kind)
    value = mi.traverse(scene)[key]
    value = type(value)(value)
    integrators = both(**FEW)
    with gc_quiet():
        for k in range(_FIRST + 4):
            if isinstance(value, mi.Transform4f):
                new = value @ mi.Transform4f().translate([0.01 * k, 0, 0.01 * k]).rotate([0, 1, 0], k)
            else:
                new = type(value)(value + 0.01 * k)
            assert_same(scene, integrators, key, new)
            assert (recordings(integrators[1]) > 0) == (k >= _FIRST)
        monkeypatch.setattr(Renderer, "render", lambda self, **options: pytest.fail("not replayed"))
        weighted_step(scene, integrators[1], key, new)


def test_views_in_turns(variant: str) -> None:
    """Each sensor has its own count; images of other samples between them are no steps."""
    scene = small_scene(aside={**camera(), "to_world": mi.ScalarTransform4f().look_at([3, -3, 2.2], [0, 0, 0.5], [0, 0, 1])})
    integrators = both()
    vertices = mi.Float(dr.detach(mi.traverse(scene)[VERTICES]))
    for k in range(_FIRST + 3):
        for sensor in (0, 1):
            assert_same(scene, integrators, VERTICES, vertices + 0.02 * k, sensor=sensor)
        assert_same(scene, integrators, VERTICES, vertices, spp=4 + k)
    assert recordings(integrators[1]) > 0


@pytest.mark.parametrize(("kind", "key", "always"), [("sky", "sky.to_world", False), ("lamps", "torch.cutoff_angle", True)])
def test_scenes_that_are_read_anew_begin_a_new_count(variant: str, kind: str, key: str, always: bool) -> None:
    """Maps are planned for each new cone of a spot, and for a sky that has turned far."""
    scene = lit_scene(kind)
    value = mi.traverse(scene)[key]
    value = type(value)(value)
    integrators = both(**FEW)
    for k in range(_FIRST + 3):
        turn = isinstance(value, mi.Transform4f)
        new = value @ mi.Transform4f().rotate([0, 1, 0], 10 * k) if turn else type(value)(value + 0.5 * k)
        assert_same(scene, integrators, key, new)
    assert not (always and recordings(integrators[1]))


def test_colours_of_lights_are_not_recorded(variant: str) -> None:
    """Surfaces and maps of the last step serve again."""
    scene, integrators = small_scene(), both()
    for k in range(_FIRST + 2):
        assert_same(scene, integrators, "sun.irradiance.value", mi.Color3f(2 + 0.1 * k))
    assert not recordings(integrators[1])


def test_materials_are_not_recorded(variant: str) -> None:
    scene = full_scene()
    params = mi.traverse(scene)
    texture = next(key for key in params.keys() if key.endswith("reflectance.data"))  # noqa: SIM118
    integrators, rng = both(), np.random.default_rng(2)
    for _ in range(_FIRST + 2):
        assert_same(scene, integrators, texture, mi.TensorXf(rng.uniform(0.2, 0.8, (4, 4, 3)).astype(np.float32)))
    assert not recordings(integrators[1])


def test_what_recordings_do_not_see_begins_a_new_count(variant: str) -> None:
    """Mitsuba leaves out lobes whose parameters are 0: when they are changed, a recording would show the old material."""
    scene = small_scene()
    ball = next(shape for shape in scene.shapes() if shape.id() == "ball")
    ball.set_bsdf(mi.load_dict({"type": "twosided", "bsdf": {"type": "principled"}}))
    params = mi.traverse(scene)
    lobe = next(key for key in params.keys() if key.endswith("metallic.value"))  # noqa: SIM118
    integrators = both()
    vertices = mi.Float(dr.detach(params[VERTICES]))
    for k in range(_FIRST + 1):
        before = assert_same(scene, integrators, VERTICES, vertices + 0.01 * k)
    made = recordings(integrators[1])
    params[lobe] = 0.8
    params.update()
    assert np.abs(assert_same(scene, integrators, VERTICES, vertices + 0.01 * k) - before).max() > 0.01
    assert recordings(integrators[1]) == made  # this step was rendered as it is


@pytest.mark.parametrize(
    ("kind", "limits", "recorded"),
    [
        ("few lights", {"MOST_OF_LATEST": 4 * 64 * 64}, False),
        ("few lights", {"_LARGEST": 0}, True),
        ("many lights", {"MOST_OF_LATEST": 4 * 64 * 64}, False),
        ("many lights", {"_LARGEST": 0}, True),
        ("lamps", {"MOST_OF_LATEST": 4 * 64 * 64}, False),
        ("lamps", {"_LARGEST": 0}, True),
        ("sky", {"_LARGEST": 4 * 64 * 64}, False),
        ("sky", {}, True),
    ],
)
def test_large_images_are_not_recorded(
    variant: str, monkeypatch: pytest.MonkeyPatch, kind: str, limits: dict[str, int], recorded: bool
) -> None:
    """Backward passes are handed what the image has found, as far as memory allows. Skies have a limit of their own."""
    for name, limit in limits.items():
        monkeypatch.setattr(scene_cache, name, limit)
    suns = {f"sun {k}": {**sun(), "direction": [0.1 * k - 0.4, 0.3, -1]} for k in range(9)} if kind == "many lights" else {}
    soft = kind in ("lamps", "sky")
    scene, key = (lit_scene(kind), "box.vertex_positions") if soft else (small_scene(**suns), VERTICES)
    vertices = mi.Float(dr.detach(mi.traverse(scene)[key]))
    integrators = both(**FEW)
    for k in range(_FIRST + 2):
        assert_same(scene, integrators, key, vertices + 0.01 * k, spp=4)
    assert (recordings(integrators[1]) > 0) == recorded


@pytest.mark.parametrize("which", ["image", "backward"])
def test_scenes_that_cannot_be_recorded_are_rendered(variant: str, monkeypatch: pytest.MonkeyPatch, which: str) -> None:
    calls: list[int] = []

    def fails(*_: object) -> None:
        calls.append(1)
        raise RuntimeError("cannot be recorded")

    scene, integrators = small_scene(), both()
    vertices = mi.Float(dr.detach(mi.traverse(scene)[VERTICES]))
    monkeypatch.setattr(scene_cache.FrozenPasses, which, fails)
    for k in range(_FIRST + 3):
        assert_same(scene, integrators, VERTICES, vertices + 0.01 * k)
    assert len(calls) == 1


def test_counts() -> None:
    steps = SteadySteps()
    assert [steps.note("a", 0) for _ in range(_FIRST + 2)] == [False] * _FIRST + [True] * 2
    assert steps.is_replayed("a") and not steps.is_replayed("b") and not steps.note("b", 0)
    steps.refuse()
    assert not steps.note("a", 0) and not steps.is_replayed("a")


@pytest.mark.parametrize(("made", "last"), [(lambda replays: replays, False), (lambda replays: 2, True)])
def test_recordings_that_are_not_replayed_end(made: Callable[[int], int], last: bool) -> None:
    """A program in which something changes at each step would record at each step."""
    steps, replays = SteadySteps(), 0
    for _ in range(_FIRST + 4 * _RECORDINGS * _REPLAYS):
        replays += steps.note("a", made(replays))
    assert steps.note("a", made(replays)) == last
    assert last or _RECORDINGS <= replays <= 2 * _RECORDINGS


@pytest.mark.parametrize("value", ["yes", 2])
def test_other_values_are_named(variant: str, value: Any) -> None:
    with pytest.raises(ShadowmapError, match="recorded"):
        Options(recorded=value)
    with pytest.raises(RuntimeError, match="'recorded' of 'shadowmap'"):  # Mitsuba's, around ours
        shadowmap(recorded=value)
    assert shadowmap(recorded="auto").shell.options.recorded == shadowmap().shell.options.recorded == "auto"

"""Results that a replayed image hands to its backward pass: they are used, and only where they still hold."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from integrator_scenes import camera, shadowmap, small_scene

from shadowmap_dr import Renderer
from shadowmap_dr.integrator import handed
from shadowmap_dr.integrator.parameter_state import ParameterState
from shadowmap_dr.integrator.recording import FrozenPasses
from shadowmap_dr.integrator.steady_steps import _FIRST

VERTICES = "ball.vertex_positions"


@pytest.fixture
def given(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Numbers of results that backward passes were given."""
    counts: list[int] = []
    backward = FrozenPasses.backward

    def noted(self: FrozenPasses, spp: int, gradient: Any, data: Any, renderer: Any, results: Any, *rest: Any) -> None:
        counts.append(len(results.unpacked()))
        backward(self, spp, gradient, data, renderer, results, *rest)

    monkeypatch.setattr(FrozenPasses, "backward", noted)
    return counts


def views() -> Any:
    aside = {**camera(), "to_world": mi.ScalarTransform4f().look_at([3, -3, 2.2], [0, 0, 0.5], [0, 0, 1])}
    return small_scene(aside=aside)


def steps(
    integrator: Any, count: int, between: Callable[[Any, int], None] = lambda params, k: None, sensors: tuple[int, ...] = (0, 1)
) -> list[tuple[np.ndarray, np.ndarray]]:
    """(sum of the images, gradient of a weighted sum) of steps with several views. ``between``: called before backward passes."""
    scene = views()
    params = mi.traverse(scene)
    vertices = mi.Float(dr.detach(params[VERTICES]))
    found = []
    for k in range(count):
        moved = mi.Float(vertices + 0.01 * k)
        dr.enable_grad(moved)
        params[VERTICES] = moved
        params.update()
        image = sum(mi.render(scene, params, sensor=sensor, integrator=integrator) for sensor in sensors)
        dr.eval(image)
        between(params, k)
        weight = np.random.default_rng(1).uniform(0, 1, image.shape).astype(np.float32)
        dr.backward(dr.sum(image * mi.TensorXf(weight), axis=None))
        found.append((image.numpy(), dr.grad(moved).numpy()))
    return found


def assert_same(found: list[tuple[np.ndarray, np.ndarray]], expected: list[tuple[np.ndarray, np.ndarray]]) -> None:
    for (image, gradient), (wanted, derivative) in zip(found, expected, strict=True):
        np.testing.assert_allclose(image, wanted, atol=1e-5)
        assert np.abs(derivative).max() > 1e-3
        np.testing.assert_allclose(gradient, derivative, atol=2e-4 * np.abs(derivative).max())


@pytest.mark.parametrize("recorded", ["auto", True])
def test_all_views_of_a_loss_hand_over(variant: str, given: list[int], recorded: str | bool) -> None:
    found = steps(shadowmap(recorded=recorded), _FIRST + 3)
    assert len(given) == 2 * (3 if recorded == "auto" else _FIRST + 3) and min(given) > 5
    assert_same(found, steps(shadowmap(recorded=False), _FIRST + 3))


@pytest.mark.parametrize("others", [0, 9])
def test_many_lights_hand_over(variant: str, given: list[int], monkeypatch: pytest.MonkeyPatch, others: int) -> None:
    """Also lights that are summed up in a loop."""
    lights = {f"sun {k}": {"type": "directional", "direction": [0.1 * k - 0.4, 0.3, -1]} for k in range(others)}
    monkeypatch.setitem(globals(), "views", lambda: small_scene(**lights))
    found = steps(shadowmap(recorded=True), 3, sensors=(0,))
    assert len(given) == 3 and min(given) > 5
    assert_same(found, steps(shadowmap(recorded=False), 3, sensors=(0,)))


@pytest.mark.parametrize("recorded", [True, False])
def test_derivatives_know_which_shapes_carry_gradients(variant: str, recorded: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pixels of other shapes have nothing to do then."""
    changed = []
    render = Renderer.render

    def noted(self: Renderer, *args: Any, **kwargs: Any) -> Any:
        if dr.grad_enabled(self.data.geometry.positions):
            changed.append(self.data.geometry.changed)
        return render(self, *args, **kwargs)

    monkeypatch.setattr(Renderer, "render", noted)
    steps(shadowmap(recorded=recorded), 2, sensors=(0,))
    assert changed and set(changed) == {("ball",)}


def change_material(params: Any, k: int) -> None:
    params["ball.bsdf.reflectance.value"] = mi.Float(0.2 + 0.02 * k)
    params.update()


def change_light(params: Any, k: int) -> None:
    params["sun.to_world"] = mi.Transform4f().rotate([0, 1, 0], 10 + k) @ mi.Transform4f().look_at(
        [0, 0, 0], [0.4, 0.3, -1], [0, 1, 0]
    )
    params.update()


def change_camera(params: Any, k: int) -> None:
    params["camera.to_world"] = mi.Transform4f().look_at([2 + 0.1 * k, -3, 4], [0, 0, 0], [0, 0, 1])
    params.update()


@pytest.mark.parametrize("between", [change_material, change_light, change_camera])
def test_derivatives_are_those_of_the_current_scene(variant: str, given: list[int], between: Callable[[Any, int], None]) -> None:
    """As without recordings, where Mitsuba asks for derivatives after a change."""
    found = steps(shadowmap(recorded=True), _FIRST, between, (0,))
    assert max(given) == 0
    for (_, gradient), (_, derivative) in zip(found, steps(shadowmap(recorded=False), _FIRST, between, (0,)), strict=True):
        length = np.linalg.norm(derivative)
        assert length > 0.1 and np.linalg.norm(gradient) == pytest.approx(length, rel=0.05)  # maps are fitted at other moments
        assert gradient @ derivative > 0.99 * length * np.linalg.norm(gradient)


def move(params: mi.SceneParameters) -> None:
    """Move the ball, with gradients to its vertices."""
    moved = mi.Float(dr.detach(params[VERTICES]) + 0.01)
    dr.enable_grad(moved)
    params[VERTICES] = moved
    params.update()


def test_later_images_without_backward_passes(variant: str, given: list[int]) -> None:
    """An evaluation between image and backward pass takes nothing away."""
    scene, integrator = views(), shadowmap(recorded=True)
    params = mi.traverse(scene)
    for _ in range(3):
        move(params)
        image = mi.render(scene, params, sensor=0, integrator=integrator)
        with dr.suspend_grad():
            mi.render(scene, sensor=1, integrator=integrator)
        dr.backward(dr.mean(image, axis=None))
    assert len(given) == 3 and min(given) > 5


def test_nothing_waits_where_nothing_is_attached(variant: str) -> None:
    scene, integrator = views(), shadowmap(recorded=True)
    mi.render(scene, integrator=integrator)
    assert not integrator.shell.scenes[0].handed._images


def test_older_results_make_room(variant: str, given: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(handed, "MOST_SAMPLES", 64 * 64)
    found = steps(shadowmap(recorded=True), 3)
    assert sorted(map(bool, given)) == [False] * 3 + [True] * 3
    assert_same(found, steps(shadowmap(recorded=False), 3))


def sheet() -> Any:
    """A faceted ``mi.Mesh``: a square at z = 0.2."""
    corners = np.array([[-1, -1, 0.2], [1, -1, 0.2], [1, 1, 0.2], [-1, -1, 0.2], [1, 1, 0.2], [-1, 1, 0.2]], np.float32)
    mesh = mi.Mesh("sheet", 6, 2, has_vertex_normals=True)
    params = mi.traverse(mesh)
    params["vertex_positions"], params["faces"] = corners.ravel(), np.arange(6, dtype=np.uint32)
    params.update()
    return mesh


@pytest.mark.parametrize("recorded", ["auto", True, False])
def test_faceted_shapes_whose_normals_change_without_gradients(variant: str, recorded: str | bool) -> None:
    """Planar and faceted shapes need less work as long as they are as they were loaded."""
    tilted = np.tile(np.float32([0.6, 0, 0.8]), 6)
    both = []
    for integrator in (shadowmap(recorded=recorded), None):
        scene = small_scene(sheet=sheet())
        params = mi.traverse(scene)
        vertices = mi.Float(dr.detach(params[VERTICES]))
        found = []
        for k in range(_FIRST + 4):
            moved = mi.Float(vertices + 0.01 * k)
            dr.enable_grad(moved)
            params[VERTICES] = moved
            if k == _FIRST + 2:
                params["sheet.vertex_normals"] = mi.Float(tilted)
            params.update()
            # A new integrator reads the scene as it is.
            image = mi.render(scene, params, integrator=integrator or shadowmap(recorded=False))
            dr.backward(dr.mean(dr.square(image), axis=None))
            found.append((image.numpy(), dr.grad(moved).numpy()))
        both.append(found)
    for (image, gradient), (expected, derivative) in zip(*both, strict=True):
        assert np.abs(image - expected).mean() < 2e-3 * expected.mean()  # maps are fitted at other moments
        assert gradient @ derivative > 0.99 * np.linalg.norm(gradient) * np.linalg.norm(derivative)
    first, last = both[0][_FIRST + 1][0], both[0][_FIRST + 2][0]
    assert np.abs(last - first).mean() > 0.02 * first.mean()


def test_renderers_know_of_normals_that_have_changed(variant: str) -> None:
    """Also where another shape gets new vertices."""
    scene = small_scene(sheet=sheet())
    params = mi.traverse(scene)
    renderer = Renderer.from_scene(scene)
    params["sheet.vertex_normals"] = mi.Float(np.tile(np.float32([0.6, 0, 0.8]), 6))
    params.update()
    vertices = {"ball": mi.Float(params[VERTICES] + 0.1)}
    before, now = renderer.render(vertices), renderer.refresh().render(vertices)
    expected = Renderer.from_scene(scene).render(vertices)
    np.testing.assert_allclose(now.numpy(), expected.numpy(), atol=1e-5)
    assert np.abs(now.numpy() - before.numpy()).mean() > 0.02 * before.numpy().mean()


def test_parameters_are_listed_twice_a_step(variant: str, given: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    """For the image and for its backward pass. What a replay renews is known from the first one."""
    listed: list[int] = []
    of = ParameterState.of

    def noted(node: mi.Object) -> ParameterState:
        listed[-1] += isinstance(node, mi.Scene)
        return of(node)

    monkeypatch.setattr(ParameterState, "of", noted)
    scene, integrator = small_scene(), shadowmap(recorded=True)
    params = mi.traverse(scene)
    for _ in range(5):
        listed.append(0)
        move(params)
        dr.backward(dr.mean(mi.render(scene, params, integrator=integrator), axis=None))
    assert listed[2:] == [2] * 3 and min(given) > 5


def dotted_material() -> Any:
    """A diffuse material in Python, whose parameter has a dot in its name."""

    class Dotted(mi.BSDF):
        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.grey = dr.opaque(mi.Float, 0.5)
            self.m_components = [mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide]
            self.m_flags = self.m_components[0]

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return mi.Spectrum(self.grey / dr.pi * dr.maximum(wo.z, 0)) & (active & (si.wi.z > 0) & (wo.z > 0))

        def traverse(self, callback: Any) -> None:
            callback.put("shade.grey", self.grey, mi.ParamFlags.Differentiable)

    mi.register_bsdf("dotted", Dotted)
    return mi.load_dict({"type": "dotted"})


def test_names_with_dots(variant: str, given: list[int]) -> None:
    scene, integrator = small_scene(), shadowmap(recorded=True)
    next(shape for shape in scene.shapes() if shape.id() == "ball").set_bsdf(dotted_material())
    params = mi.traverse(scene)
    for _ in range(4):
        move(params)
        dr.backward(dr.mean(mi.render(scene, params, integrator=integrator), axis=None))
    assert len(given) == 4 and min(given) > 5

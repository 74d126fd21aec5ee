"""The plug-in: what is kept from one image to the next, what is noticed, and what is recorded."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Iterator
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from integrator_scenes import SOFT, ball, camera, render, scaled, shadowmap, small_scene, sun, translated

from shadowmap_dr.integrator import scene_cache as plugin


def _all_messages(error: BaseException | None) -> str:
    """Dr.Jit wraps what an integrator raises."""
    return "" if error is None else f"{error} | {_all_messages(error.__cause__ or error.__context__)}"


@pytest.fixture
def loads(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Any]]:
    """Scenes that were read from scratch."""
    seen: list[Any] = []
    original = plugin.load

    def load(scene: Any, **options: Any) -> Any:
        seen.append(scene)
        return original(scene, **options)

    monkeypatch.setattr(plugin, "load", load)
    yield seen


def test_scene_is_read_once(variant: str, loads: list[Any]) -> None:
    scene, integrator = small_scene(), shadowmap()
    params = mi.traverse(scene)
    first = render(scene, integrator)
    for key, value in (("ball.vertex_positions", translated), ("sun.irradiance.value", scaled)):
        params[key] = value(params[key], 0.1)
        dr.enable_grad(params[key])
    params.update()
    image = mi.render(scene, params, integrator=integrator)
    dr.backward(dr.sum(image))
    assert not np.array_equal(first, image.numpy())
    assert len(loads) == 1
    other = small_scene(sun=sun(direction=[0, 0, -1]))
    assert np.array_equal(render(other, integrator), render(other))
    assert np.array_equal(render(scene, integrator), image.numpy())
    assert len(loads) == 3  # the two integrators read `other`, none read `scene` again


def test_new_topology_is_noticed(variant: str, loads: list[Any]) -> None:
    scene, integrator = small_scene(), shadowmap()
    render(scene, integrator)
    params = mi.traverse(scene)
    faces = params["ball.faces"].numpy().copy()
    params["ball.faces"] = mi.UInt32(faces)
    params.update()
    render(scene, integrator)
    assert len(loads) == 1
    params["ball.faces"] = mi.UInt32(np.roll(faces, 3))
    params.update()
    assert np.array_equal(render(scene, integrator), render(scene))
    mesh = ball(3)
    finer = mi.traverse(mesh)
    for key in ("faces", "vertex_positions", "vertex_normals"):
        params[f"ball.{key}"] = finer[key]
    params.update()
    assert np.array_equal(render(scene, integrator), render(scene))
    assert loads == [scene] * 5


def test_wider_spot_light_is_noticed(variant: str) -> None:
    """Beyond 60 degrees a spot light has six maps instead of one."""
    spot = {"type": "spot", "cutoff_angle": 40.0, "to_world": mi.ScalarTransform4f().look_at([0, 0, 2], [0, 0, 0], [0, 1, 0])}
    scene, integrator = small_scene(sun=spot), shadowmap()
    render(scene, integrator)
    params = mi.traverse(scene)
    params["sun.cutoff_angle"] = 75.0
    params.update()
    assert np.array_equal(render(scene, integrator), render(scene))


def test_derivatives_see_the_frusta_of_the_image(variant: str) -> None:
    """Although images of another sensor, which sees less and has other frusta, come in between."""
    sideways = mi.ScalarTransform4f().look_at([0.3, -3, 1.2], [0.3, 0, 1.2], [0, 0, 1])
    scene, integrator = small_scene(close={**camera(fov=1), "to_world": sideways}), shadowmap()
    params = mi.traverse(scene)
    key = "ball.vertex_positions"
    for shift in (0.0, 0.02, 0.7):  # kept, kept, fitted anew
        params[key] = translated(dr.detach(params[key]), shift)
        dr.enable_grad(params[key])
        params.update()
        image = mi.render(scene, params, integrator=integrator)
        before = _frusta(integrator)
        mi.render(scene, params, integrator=integrator, sensor=1)
        assert not np.array_equal(before, _frusta(integrator))
        loss, gradients = dr.sum(image), []
        for _ in range(2):  # with what the image has left behind, and without
            dr.set_grad(params[key], 0.0)
            dr.backward(loss, flags=dr.ADFlag.ClearInterior)
            gradients.append(dr.grad(params[key]).numpy())
        assert np.array_equal(before, _frusta(integrator))
        np.testing.assert_allclose(gradients[0], gradients[1], atol=1e-5 * np.abs(gradients[1]).max())
        mi.render(scene, params, integrator=integrator, sensor=1)
        dr.set_grad(params[key], 1.0)
        integrator.render_forward(scene, params)
        assert np.array_equal(before, _frusta(integrator))


def _frusta(integrator: Any) -> np.ndarray:
    """Numbers of the frusta of the latest image."""
    _, frusta, _ = integrator.shell.scenes[0].fits[0]
    return np.array(list(frusta.arrays().values()))


def test_scenes_are_not_kept_alive(variant: str) -> None:
    scene = small_scene(integrator={"type": "shadowmap"})
    mi.render(scene).numpy()
    params = mi.traverse(scene)
    dr.enable_grad(params["ball.vertex_positions"])
    params.update()
    mi.render(scene, params).numpy()  # no one asks for its derivatives
    alive = weakref.ref(scene.integrator())
    del scene, params
    gc.collect()
    assert alive() is None
    integrator = shadowmap()
    for _ in range(6):
        render(small_scene(camera=camera(4)), integrator)
    assert len(integrator.shell.scenes) <= 4
    scene = small_scene()
    for _ in range(70):
        render(scene, integrator, sensor=mi.load_dict(camera(1)))
    # One that is new for each image is soon forgotten.
    assert len(integrator.shell.scenes[0].fits) <= 9


def test_frozen_loop(variant: str) -> None:
    """``mi.render`` and its backward pass inside ``dr.freeze``."""
    scene, integrator = small_scene(camera=camera(16)), shadowmap(**SOFT)
    params = mi.traverse(scene)
    key = "sun.irradiance.value"

    @dr.freeze
    def step(scene: Any, params: Any, integrator: Any, x: Any) -> Any:
        dr.enable_grad(x)
        params[key] = mi.Color3f(x, x, x)
        params.update()
        loss = dr.sum(mi.render(scene, params, integrator=integrator))
        dr.backward(loss)
        gradient = dr.grad(x)
        dr.disable_grad(x)
        params[key] = dr.detach(params[key])
        params.update()
        return dr.detach(loss), gradient

    mi.render(scene, integrator=integrator)
    results = [step(scene, params, integrator, mi.Float(1.0 + i)) for i in range(5)]
    assert step.n_recordings <= 3
    for i, (loss, gradient) in enumerate(results):
        assert loss.array[0] == pytest.approx((1 + i) * results[0][0].array[0], rel=1e-5)
        assert gradient[0] == pytest.approx(results[0][0].array[0], rel=1e-5)


def test_scene_cannot_be_read_while_recording(variant: str) -> None:
    @dr.freeze
    def image(scene: Any, integrator: Any) -> Any:
        return mi.render(scene, integrator=integrator)

    with pytest.raises(RuntimeError) as error:
        image(small_scene(), shadowmap())
    assert "render it once with this integrator before" in _all_messages(error.value)

"""Images that wait for their backward pass: they are rendered once, and only the scene that they show counts."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from integrator_scenes import camera, shadowmap, small_scene
from lit_scenes import lit_scene

from shadowmap_dr.integrator import deferred
from shadowmap_dr.rendering.renderer import Renderer

KEY = "ball.vertex_positions"


@pytest.fixture
def renderings(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Samples per pixel of all renderings."""
    seen: list[int] = []
    render = Renderer.render

    def counted(self: Renderer, *args: Any, **options: Any) -> Any:
        seen.append(options["spp"])
        return render(self, *args, **options)

    monkeypatch.setattr(Renderer, "render", counted)
    return seen


def scene_of_two() -> Any:
    aside = mi.ScalarTransform4f().look_at([3, -3, 2.2], [0, 0, 0.5], [0, 0, 1])
    return small_scene(aside={**camera(), "to_world": aside})


def moved(params: Any, by: float) -> Any:
    """New vertices, put into the scene."""
    vertices = dr.detach(params[KEY]) + by
    dr.enable_grad(vertices)
    params[KEY] = vertices
    params.update()
    return vertices


def gradient(variables: Any, loss: Any) -> np.ndarray:
    dr.backward(loss)
    return dr.grad(variables).numpy()


def test_backward_passes_do_not_render_again(variant: str, renderings: list[int]) -> None:
    scene, integrator = scene_of_two(), shadowmap()
    params = mi.traverse(scene)
    for by in (0.0, 0.1):
        vertices = moved(params, by)
        loss = sum(dr.sum(mi.render(scene, params, integrator=integrator, sensor=k, spp=4)) for k in range(2))
        found = gradient(vertices, loss)
    assert renderings == [4] * 4
    vertices = moved(params, 0.0)
    images = [integrator.shell.image(scene, scene.sensors()[k], 4) for k in range(2)]
    expected = gradient(vertices, sum(dr.sum(image) for image in images))
    assert np.abs(expected).max() > 1
    np.testing.assert_allclose(found, expected, atol=2e-3 * np.abs(expected).max())


def test_what_has_changed_meanwhile_is_rendered_again(variant: str, renderings: list[int]) -> None:
    scene, integrator = scene_of_two(), shadowmap()
    params = mi.traverse(scene)
    moved(params, 0.0)
    image = mi.render(scene, params, integrator=integrator)
    vertices = moved(params, 0.3)
    late = gradient(vertices, dr.sum(image))
    assert len(renderings) == 2
    vertices = moved(params, 0.0)
    expected = gradient(vertices, dr.sum(mi.render(scene, params, integrator=integrator)))
    assert len(renderings) == 3 and np.abs(expected).max() > 1
    np.testing.assert_allclose(late, expected, atol=1e-3 * np.abs(expected).max())
    # Another camera, or other samples, are other images.
    mi.render(scene, params, integrator=integrator, spp=1)
    integrator.render_backward(scene, params, dr.ones(mi.TensorXf, (64, 64, 3)), spp=4)
    integrator.render_backward(scene, params, dr.ones(mi.TensorXf, (64, 64, 3)), sensor=1, spp=1)
    assert renderings[3:] == [1, 4, 1]


def test_memory_is_bounded(variant: str, renderings: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(deferred, "MOST_SAMPLES", 64 * 64)
    scene, integrator = scene_of_two(), shadowmap()
    params = mi.traverse(scene)
    vertices = moved(params, 0.0)
    loss = sum(dr.sum(mi.render(scene, params, integrator=integrator, sensor=k)) for k in range(2))
    gradient(vertices, loss)
    assert len(renderings) == 3  # the last one waited
    gradient(vertices, dr.sum(mi.render(scene, params, integrator=integrator, spp=4)))
    assert renderings[3:] == [4, 4]


def test_maps_count_as_memory(variant: str) -> None:
    """Images of a scene with many maps hold much more than their pixels."""
    above = mi.ScalarTransform4f().translate([0, 0, 3])
    lamp = {"type": "rectangle", "to_world": above, "emitter": {"type": "area", "radiance": 1.0}}
    scene, integrator = small_scene(lamp=lamp), shadowmap(area_light_samples=32, soft_map_resolution=256)
    params = mi.traverse(scene)
    moved(params, 0.0)
    views = [mi.load_dict(camera()) for _ in range(6)]
    images = [mi.render(scene, params, sensor=view, integrator=integrator) for view in views]
    (record,) = integrator.shell.scenes
    assert record.renderer.texels == 256**2 + 32 * 256**2
    waiting = record.waiting._images
    assert len(images) == 6 and 1 <= len(waiting) <= 3
    assert sum(one.weight for one in waiting) <= deferred.MOST_SAMPLES


def test_forward_passes_do_not_run_through_images_that_wait(variant: str) -> None:
    scene, integrator = scene_of_two(), shadowmap()
    params = mi.traverse(scene)
    moved(params, 0.0)
    mi.render(scene, params, integrator=integrator)
    image = integrator.shell.scenes[0].waiting._images[0].image
    dr.set_grad(params[KEY], 1.0)
    derivative = dr.forward_to(mi.render(scene, params, integrator=integrator, sensor=1)).numpy()
    assert np.abs(derivative).max() > 0.1 and not dr.grad(image).array.numpy().any()


@pytest.mark.parametrize(
    ("kind", "key"),
    [
        *(("sky", key) for key in ("sky.to_world", "camera.to_world", "box.vertex_positions")),
        *(("lamps", key) for key in ("lamp.to_world", "lamp.emitter.radiance.value", "bulb.position", "bulb.intensity.value")),
        *(("lamps", key) for key in ("torch.to_world", "torch.cutoff_angle", "box.vertex_normals", "floor.to_world")),
    ],
)
def test_forward_agrees_with_backward_that_has_waited(variant: str, kind: str, key: str) -> None:
    """Both go on from a number that parameters are computed from, through what Mitsuba has derived from them."""
    derivatives = []
    for forward in (True, False):
        scene = lit_scene(kind)
        integrator = shadowmap(area_light_samples=4, environment_light_samples=8)
        params = mi.traverse(scene)
        shift = dr.opaque(mi.Float, 0)
        dr.enable_grad(shift)
        if isinstance(params[key], mi.Transform4f):
            turn = mi.Transform4f().rotate([0.2, 1, 0], 10 * shift)
            params[key] = params[key] @ turn @ mi.Transform4f().translate(mi.Vector3f(shift, 0.3 * shift, 0))
        else:
            params[key] = type(params[key])(params[key] + shift)
        params.update()
        image = mi.render(scene, params, integrator=integrator)
        assert len(integrator.shell.scenes[0].waiting._images) == 1
        weight = np.random.default_rng(1).uniform(0, 1, image.shape).astype(np.float32)
        if forward:
            dr.forward(shift)
            derivatives.append(float((dr.grad(image).numpy() * weight).sum()))
        else:
            dr.backward(dr.sum(image * mi.TensorXf(weight), axis=None))
            derivatives.append(float(dr.grad(shift)[0]))
    assert abs(derivatives[1]) > 1e-3 and derivatives[0] == pytest.approx(derivatives[1], rel=1e-3)

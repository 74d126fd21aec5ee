"""``recorded``: what is replayed is what would have been rendered, whatever has changed meanwhile."""

from __future__ import annotations

import gc
import weakref
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from integrator_scenes import camera, full_scene, recordings, shadowmap, small_scene, weighted_step
from lit_scenes import lit_scene
from unaligned import unaligned

from shadowmap_dr import ShadowmapError
from shadowmap_dr.jit.gc import gc_quiet
from shadowmap_dr.rendering.renderer import Renderer

VERTICES = "ball.vertex_positions"
FEW = {"area_light_samples": 4, "environment_light_samples": 8}


def both(**options: Any) -> tuple[Any, Any]:
    """The plug-in as it is, and recorded."""
    return shadowmap(**options), shadowmap(recorded=True, **options)


def assert_same(plain: tuple[np.ndarray, np.ndarray], replayed: tuple[np.ndarray, np.ndarray]) -> None:
    np.testing.assert_allclose(replayed[0], plain[0], atol=1e-5)
    assert np.abs(plain[1]).max() > 1e-3
    np.testing.assert_allclose(replayed[1], plain[1], atol=2e-4 * np.abs(plain[1]).max())


def test_steps_are_replayed(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = small_scene(aside={**camera(), "to_world": mi.ScalarTransform4f().look_at([3, -3, 2.2], [0, 0, 0.5], [0, 0, 1])})
    plain, recorded = both()
    vertices = mi.Float(dr.detach(mi.traverse(scene)[VERTICES]))
    counts = []
    with gc_quiet():  # other tests' scenes, freed meanwhile, would make it record anew
        for by in (0.0, 0.02, 0.1, -0.3, 0.2, -0.1):
            for sensor in (0, 1):
                assert_same(*(weighted_step(scene, one, VERTICES, vertices + by, sensor=sensor) for one in (plain, recorded)))
            counts.append(recordings(recorded))
        # The second camera is the first one with other numbers. At first Mitsuba's own arrays, and fits, still change their kind.
        assert 2 <= counts[0] <= 4 and counts[3] <= 8 and counts[3:] == 3 * counts[3:4]
        monkeypatch.setattr(Renderer, "render", lambda self, **options: pytest.fail("not replayed"))
        weighted_step(scene, recorded, VERTICES, vertices + 0.05)


def test_views_in_one_call(variant: str) -> None:
    """Through a batch sensor: the images, and the derivatives of their sum, of its cameras one by one, under the sky and the sun.

    But for the fit of the maps, which is one for all that the cameras see.
    """
    aside = {**camera(), "to_world": mi.ScalarTransform4f().look_at([3, -3, 2.2], [0, 0, 0.5], [0, 0, 1])}
    film = {**camera()["film"], "width": 128, "height": 64}
    views = {"type": "batch", "film": film, "a": camera(), "b": aside}
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": 0.5}}
    scene = small_scene(aside=aside, views=views, sky=sky)
    vertices = mi.Float(dr.detach(mi.traverse(scene)[VERTICES]))
    together = shadowmap(recorded=True, environment_light_samples=8)
    weight = np.random.default_rng(1).uniform(0, 1, (64, 128, 3)).astype(np.float32)
    for by in (0.0, 0.02, 0.05):
        found = []
        for integrator, sensors in ((shadowmap(environment_light_samples=8), (0, 1)), (together, (2,))):
            params = mi.traverse(scene)
            moved = mi.Float(vertices + by)
            dr.enable_grad(moved)
            params[VERTICES] = moved
            params.update()
            images = [mi.render(scene, params, sensor=sensor, integrator=integrator) for sensor in sensors]
            image = dr.concat(images, axis=1)
            dr.backward(dr.sum(image * mi.TensorXf(weight), axis=None))
            found.append((image.numpy(), dr.grad(moved).numpy()))
        (image, gradient), (one_image, one_gradient) = found
        assert np.abs(one_image - image).mean() < 2e-3 * image.mean()
        length = np.linalg.norm(gradient)
        assert gradient @ one_gradient > 0.99 * length * np.linalg.norm(one_gradient)
        assert np.linalg.norm(one_gradient) == pytest.approx(length, rel=0.02)


def test_gradients_may_lie_anywhere(variant: str) -> None:
    """Dr.Jit borrows NumPy's memory, and would record anew for other alignments."""
    scene, (_, recorded) = small_scene(), both()
    params = mi.traverse(scene)
    vertices = mi.Float(dr.detach(params[VERTICES]))
    weight = np.random.default_rng(1).uniform(0, 1, (64, 64, 3)).astype(np.float32)
    counts, gradients = [], []
    with gc_quiet():
        for k, offset in enumerate((0, 0, 0, 1, 4)):
            moved = vertices + 0.01 * (k % 2 + 1)
            dr.enable_grad(moved)
            params[VERTICES] = moved
            params.update()
            image = mi.render(scene, params, integrator=recorded)
            dr.backward(dr.sum(image * mi.TensorXf(unaligned(weight, offset)), axis=None))
            counts.append(recordings(recorded))
            gradients.append(dr.grad(moved).numpy())
    assert counts[2:] == 3 * counts[2:3]
    assert np.abs(gradients[1]).max() > 1e-3
    np.testing.assert_allclose(gradients[3], gradients[1], atol=2e-4 * np.abs(gradients[1]).max())


@pytest.mark.parametrize(
    ("kind", "key"),
    [
        ("sky", "sky.to_world"),
        ("sky", "box.vertex_positions"),
        ("sky", "camera.to_world"),
        ("lamps", "lamp.to_world"),
        ("lamps", "lamp.emitter.radiance.value"),
        ("lamps", "bulb.position"),
        ("lamps", "torch.cutoff_angle"),
        ("lamps", "floor.to_world"),
    ],
)
def test_lights_and_cameras_have_gradients(variant: str, kind: str, key: str) -> None:
    scene = lit_scene(kind)
    value = mi.traverse(scene)[key]
    value = type(value)(value)
    plain, recorded = both(**FEW)
    for by in (0.0, 0.01, 0.02):
        if isinstance(value, mi.Transform4f):
            new = value @ mi.Transform4f().translate([by, 0, by])
        else:
            new = type(value)(value + by)
        assert_same(*(weighted_step(scene, integrator, key, new) for integrator in (plain, recorded)))


def test_materials_may_change_and_have_gradients(variant: str) -> None:
    scene = full_scene()
    params = mi.traverse(scene)
    texture = next(key for key in params.keys() if key.endswith("reflectance.data"))
    plain, recorded = both()
    vertices = mi.Float(dr.detach(params[VERTICES]))
    images = []
    for value in (0.2, 0.7):
        params[texture] = dr.full(mi.TensorXf, value, (4, 4, 3))
        params.update()
        expected, found = (weighted_step(scene, integrator, VERTICES, vertices) for integrator in (plain, recorded))
        assert_same(expected, found)
        images.append(found[0])
    assert np.abs(images[1] - images[0]).max() > 0.1
    # The backward pass to what Mitsuba evaluates itself is not recorded.
    new = mi.TensorXf(np.random.default_rng(2).uniform(0.2, 0.8, (4, 4, 3)).astype(np.float32))
    params[VERTICES] = vertices
    assert_same(*(weighted_step(scene, integrator, texture, new) for integrator in (plain, recorded)))


@pytest.mark.parametrize("case", ["principled metallic", "principled clearcoat", "principledthin diff_trans"])
def test_lobes_that_are_switched_on(variant: str, case: str) -> None:
    """Mitsuba leaves out lobes of materials whose parameters are 0, which Dr.Jit does not see, until these are changed."""
    kind, lobe = case.split()
    scene = small_scene()
    ball = next(shape for shape in scene.shapes() if shape.id() == "ball")
    ball.set_bsdf(mi.load_dict({"type": "twosided", "bsdf": {"type": kind}} if kind == "principled" else {"type": kind}))
    params = mi.traverse(scene)
    value = next(key for key in params.keys() if key.endswith(f"{lobe}.value"))
    plain, recorded = both()
    vertices = mi.Float(dr.detach(params[VERTICES]))

    def compare() -> np.ndarray:
        expected, found = (weighted_step(scene, integrator, VERTICES, vertices) for integrator in (plain, recorded))
        assert_same(expected, found)
        return found[0]

    for height in (0.0, 0.1, 0.2):
        vertices = vertices + mi.Float(height * np.tile([0, 0, 1], dr.width(vertices) // 3))
        before = compare()
    count = recordings(recorded)
    params[value] = 0.8
    params.update()
    assert np.abs(compare() - before).max() > 0.01
    # And no more often than that.
    made = recordings(recorded)
    params[value] = 0.6
    params.update()
    compare()
    assert made <= count + 2 and recordings(recorded) <= made


def test_other_sizes_are_recorded_anew(variant: str) -> None:
    plain, recorded = both()
    scene = small_scene()
    vertices = mi.Float(dr.detach(mi.traverse(scene)[VERTICES]))
    film = mi.traverse(scene)["camera.film.size"]
    for arguments in ({"spp": 1}, {"spp": 4}, {"spp": 1}):
        assert_same(*(weighted_step(scene, integrator, VERTICES, vertices, **arguments) for integrator in (plain, recorded)))
    params = mi.traverse(scene)
    params["camera.film.size"] = film // 2
    params.update()
    expected, found = (weighted_step(scene, integrator, VERTICES, vertices) for integrator in (plain, recorded))
    assert found[0].shape == (32, 32, 3)
    assert_same(expected, found)


def test_a_sky_of_another_resolution_is_recorded_anew(variant: str) -> None:
    """Mitsuba keeps the resolution where Dr.Jit does not see it."""
    rng = np.random.default_rng(5)
    sky = {"type": "envmap", "bitmap": mi.Bitmap(rng.uniform(0.1, 2, (8, 17, 3)).astype(np.float32))}
    scene = small_scene(light=sky)
    params = mi.traverse(scene)
    plain, recorded = both(**FEW)
    for rows in (8, 8, 16, 16, 32, 8, 16):
        params["light.data"] = mi.TensorXf(1 + 0.3 * rng.uniform(0, 1, (rows, 2 * rows + 1, 3)).astype(np.float32))
        params.update()
        images = [mi.render(scene, integrator=one).numpy() for one in (plain, recorded)]
        np.testing.assert_allclose(*images, atol=1e-5)


def test_other_scenes_come_and_go(variant: str) -> None:
    """Mitsuba's objects have numbers, which recordings may have seen."""
    plain, recorded = both()
    scene, others = small_scene(), [full_scene() for _ in range(2)]
    vertices = mi.Float(dr.detach(mi.traverse(scene)[VERTICES]))
    for by in (0.0, 0.1, 0.2, 0.3):
        assert_same(*(weighted_step(scene, integrator, VERTICES, vertices + by) for integrator in (plain, recorded)))
        if by == 0.1:
            others += [full_scene()]
        elif others:
            others.pop(0)


def test_scenes_are_not_kept_alive(variant: str) -> None:
    scene = small_scene(integrator={"type": "shadowmap", "recorded": True})
    params = mi.traverse(scene)
    dr.enable_grad(params[VERTICES])
    params.update()
    dr.backward(dr.sum(mi.render(scene, params)))
    assert recordings(scene.integrator()) == 2
    alive = weakref.ref(scene.integrator())
    del scene, params
    gc.collect()
    assert alive() is None


def test_aovs_and_bad_samples(variant: str) -> None:
    scene = small_scene()
    plain, recorded = both(aovs="depth,visibility")
    images = [mi.render(scene, integrator=integrator).numpy() for integrator in (plain, recorded)]
    assert images[1].shape == images[0].shape and recorded.aov_names() == plain.aov_names()
    np.testing.assert_allclose(images[1], images[0], atol=1e-5)
    with pytest.raises(ShadowmapError, match="spp is -1"):
        recorded.shell.primal(scene, scene.sensors()[0], -1)


def test_within_a_frozen_function(variant: str) -> None:
    """A user's own recording goes before."""
    scene = small_scene()
    plain, recorded = both()
    mi.render(scene, integrator=recorded)
    before = recordings(recorded)

    @dr.freeze
    def image(scene: Any) -> Any:
        return mi.render(scene, integrator=recorded)

    for _ in range(3):
        np.testing.assert_allclose(image(scene).numpy(), mi.render(scene, integrator=plain).numpy(), atol=1e-5)
    assert recordings(recorded) == before


@pytest.mark.parametrize("material", ["principled", "roughplastic", "diffuse"])
def test_replays_leave_materials_as_they_are(variant: str, material: str) -> None:
    """``params.update()`` tells those objects alone that have changed.

    Before, all materials had new arrays after each replay: rough plastic took 70 ms in each update, and ``principled`` switched
    all its lobes on, so that later images under a sky were others.
    """
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": 0.5}}
    scene = small_scene(sky=sky, more={"type": "sphere", "center": [1, 0, 0.4], "radius": 0.3, "bsdf": {"type": material}})
    params, told = mi.traverse(scene), []
    (bsdf,) = (shape.bsdf() for shape in scene.shapes() if shape.id() == "more")
    flags, vertices = bsdf.flags(), mi.Float(dr.detach(params[VERTICES]))
    for by in (0.1, 0.0):  # Mitsuba makes normals
        params[VERTICES] = vertices + by
        params.update()
    before = np.array(mi.render(scene, integrator=shadowmap(**FEW)))
    recorded = shadowmap(recorded=True, **FEW)
    for k in range(4):
        moved = vertices + 0.01 * k
        dr.enable_grad(moved)
        params[VERTICES] = moved
        told.append({node.class_name() for node, _ in params.update()})
        dr.backward(dr.mean(mi.render(scene, params, integrator=recorded), axis=None))
    assert recordings(recorded) and all(names == told[0] for names in told)
    params[VERTICES] = vertices
    params.update()
    assert bsdf.flags() == flags
    np.testing.assert_allclose(np.array(mi.render(scene, integrator=shadowmap(**FEW))), before, atol=2e-5)

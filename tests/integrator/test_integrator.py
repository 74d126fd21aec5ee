"""The plug-in: ``mi.render`` in all modes, against Mitsuba's own images. Its derivatives: test_gradients.py."""

from __future__ import annotations

import traceback
import warnings

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from integrator_scenes import (
    SIZE,
    SOFT,
    camera,
    full_scene,
    relative_error,
    render,
    shadowmap,
    small_scene,
    translated,
    weights,
)

from shadowmap_dr.scene.load import load
from shadowmap_dr.scene.shapes import sources


def test_image_agrees_with_path_tracing(variant: str) -> None:
    scene = full_scene()
    image = render(scene, shadowmap(shadow_map_resolution=512), spp=16)
    assert image.shape == (SIZE, SIZE, 3)
    assert relative_error(image, render(scene, mi.load_dict({"type": "direct"}), spp=2048)) < 0.02


def test_result_is_a_detached_tensor(variant: str) -> None:
    scene = small_scene()
    params = mi.traverse(scene)
    dr.enable_grad(params["sun.irradiance.value"])
    params.update()
    integrator = shadowmap()
    image = integrator.render(scene)
    assert isinstance(image, mi.TensorXf) and not dr.grad_enabled(image)
    assert dr.grad_enabled(mi.render(scene, params, integrator=integrator))


def test_spp(variant: str) -> None:
    scene = small_scene()
    integrator = shadowmap()
    default = render(scene, integrator)
    assert np.array_equal(default, render(scene, integrator, spp=1))
    four = render(scene, integrator, spp=4)
    assert not np.array_equal(default, four)
    assert np.array_equal(four, render(scene, integrator, spp=3))  # ceil(sqrt(3)) = 2
    assert not np.array_equal(four, render(scene, integrator, spp=5))
    tiny = small_scene(camera=camera(8))
    assert np.array_equal(render(tiny, integrator, spp=256), render(tiny, integrator, spp=5000))
    assert np.array_equal(default, render(scene, integrator, seed=7))


def test_hide_emitters_and_ambient(variant: str) -> None:
    scene = small_scene(floor=None, sky={"type": "constant", "radiance": {"type": "rgb", "value": [0.1, 0.2, 0.3]}})
    assert np.allclose(render(scene)[0, 0], [0.1, 0.2, 0.3])
    assert np.allclose(render(scene, shadowmap(hide_emitters=True))[0, 0], 0)
    dark, lit = (render(small_scene(), shadowmap(ambient=value)) for value in (0.0, 0.5))
    assert np.allclose(lit[60, 10] - dark[60, 10], 0.25, atol=1e-3)  # 0.5 * the floor's reflectance of 0.5


def test_texture_gradient_is_an_image(variant: str) -> None:
    scene = full_scene()
    params = mi.traverse(scene)
    key = "floor.bsdf.reflectance.data"
    dr.enable_grad(params[key])
    params.update()
    dr.backward(dr.sum(mi.render(scene, params, integrator=shadowmap(**SOFT))))
    gradient = dr.grad(params[key]).numpy()
    assert gradient.shape == (4, 4, 3)
    assert np.isfinite(gradient).all() and (gradient[1:3, 1:3] > 0).all()


def test_optimiser_moves_the_ball_back(variant: str) -> None:
    """The usual loop of Mitsuba's tutorials, with the shadow as the only thing in view."""
    shadow_only = camera(32, crop_offset_x=20, crop_offset_y=0, crop_width=12, crop_height=24)
    scene = small_scene(camera=shadow_only)
    integrator = shadowmap(**SOFT)
    reference = mi.render(scene, integrator=integrator)
    assert reference.numpy().min() < 0.2 * reference.numpy().max()
    params = mi.traverse(scene)
    key = "ball.vertex_positions"
    rest = mi.Float(params[key])
    adam = mi.ad.Adam(lr=0.02, params={"shift": mi.Float(0.2)})
    for _ in range(45):
        params[key] = rest + adam["shift"] * mi.Float(np.tile(np.float32([1, 0, 0]), dr.width(rest) // 3))
        params.update()
        loss = dr.mean(dr.square(mi.render(scene, params, integrator=integrator) - reference))
        dr.backward(loss)
        adam.step()
    assert abs(adam["shift"][0]) < 0.03


def test_instances(variant: str) -> None:
    """Their places may be attached even before the first image, and the mesh that they show."""
    cube = {"type": "cube", "to_world": mi.ScalarTransform4f().scale(0.3)}
    place = mi.ScalarTransform4f().translate([0.5, 0, 0.5]).rotate([0, 0, 1], 30)
    instance = {"type": "instance", "to_world": place, "group": {"type": "ref", "id": "group"}}
    scene = small_scene(ball=None, group={"type": "shapegroup", "cube": cube}, one=instance)
    integrator, weight = shadowmap(**SOFT), mi.TensorXf(weights((SIZE, SIZE, 3)))
    params = mi.traverse(scene)
    shift = mi.Float(0)
    dr.enable_grad(shift)
    params["one.to_world"] = mi.Transform4f().translate(mi.Vector3f(shift, 0, 0)) @ mi.Transform4f(place)
    params.update()
    dr.backward(dr.sum(mi.render(scene, params, integrator=integrator) * weight))
    params["one.to_world"] = mi.Transform4f(place)
    dr.enable_grad(params["group.cube.vertex_positions"])
    params.update()
    image = mi.render(scene, params, integrator=integrator)
    assert relative_error(image.numpy(), render(scene, mi.load_dict({"type": "direct"}), spp=256)) < 0.03
    dr.backward(dr.sum(image * weight))
    # Moving the instance along x is moving its vertices along x in the world.
    gradient = dr.unravel(mi.Vector3f, dr.grad(params["group.cube.vertex_positions"]))
    along_x = mi.Transform4f(place).inverse() @ mi.Vector3f(1, 0, 0)
    assert dr.grad(shift)[0] == pytest.approx(dr.sum(dr.dot(along_x, gradient))[0], rel=1e-3)


@pytest.mark.parametrize("first", ["cube", "cylinder"])
def test_groups_of_instances_are_told_apart(variant: str, first: str) -> None:
    """Of several groups, also if the first shape of one is a cylinder that stands upright at the origin."""
    groups = {
        "a": {"type": "shapegroup", "one": {"type": first}},
        "b": {"type": "shapegroup", "two": {"type": "sphere", "radius": 0.3}},
    }
    scale = mi.ScalarTransform4f().translate([0, 0, 0.3]).scale(0.3)
    instances = {f"i{name}": {"type": "instance", "g": {"type": "ref", "id": name}, "to_world": scale} for name in groups}
    names = [info.name for info in load(small_scene(ball=None, **groups, **instances)).geometry.shapes]
    assert sorted(names) == ["floor", "ia.one", "ib.two"]


def test_instances_and_what_they_show_may_both_be_attached(variant: str) -> None:
    """At the first image already: Mitsuba's own intersection code, which is not asked where there is one group, refuses."""
    cube = {"type": "cube", "to_world": mi.ScalarTransform4f().scale(0.3)}
    instance = {"type": "instance", "group": {"type": "ref", "id": "group"}}
    scene = small_scene(ball=None, group={"type": "shapegroup", "cube": cube}, one=instance)
    params = mi.traverse(scene)
    shift = mi.Float(0)
    dr.enable_grad(shift)
    params["group.cube.vertex_positions"] = params["group.cube.vertex_positions"] + 0.5 * shift
    params["one.to_world"] = mi.Transform4f().translate(mi.Vector3f(0.5 * shift)) @ params["one.to_world"]
    params.update()
    both = mi.render(scene, params, integrator=shadowmap(**SOFT))
    dr.forward(shift)
    # Both motions are the same.
    params["group.cube.vertex_positions"] = mi.Float(dr.detach(params["group.cube.vertex_positions"]))
    params["one.to_world"] = mi.Transform4f().translate(mi.Vector3f(shift))
    params.update()
    one = mi.render(scene, params, integrator=shadowmap(**SOFT))
    dr.forward(shift)
    assert np.abs(dr.grad(one).numpy()).max() > 1
    np.testing.assert_allclose(dr.grad(both).numpy(), dr.grad(one).numpy(), atol=1e-3)


@pytest.mark.parametrize("recorded", [False, True])
@pytest.mark.parametrize("mode", ["forward", "backward"])
@pytest.mark.parametrize("shape", ["floor", "ball"])
def test_two_images_in_one_pass(variant: str, shape: str, mode: str, recorded: bool) -> None:
    """Mitsuba's vertices of a rectangle hang on ``to_world``, and its normals of a mesh on the vertices, by edges that the first
    pass through them takes away."""
    scene = small_scene(other={**camera(), "to_world": mi.ScalarTransform4f().look_at([3, -3, 3], [0, 0, 0], [0, 0, 1])})
    params, integrator = mi.traverse(scene), shadowmap(**SOFT, recorded=recorded)
    key = {"floor": "floor.to_world", "ball": "ball.vertex_positions"}[shape]
    params.keep([key])
    place = type(params[key])(params[key])

    def derivative(*sensors: int) -> float:
        x = mi.Float(0)
        dr.enable_grad(x)
        params[key] = mi.Transform4f().rotate([1, 0, 0], x) @ place if shape == "floor" else translated(place, x)
        params.update()
        total = dr.sum(dr.concat([mi.render(scene, params, sensor=k, integrator=integrator).array for k in sensors]))
        if mode == "forward":
            dr.forward(x)
            return float(dr.grad(total)[0])
        dr.backward(total)
        return float(dr.grad(x)[0])

    single = [derivative(0), derivative(1)]
    assert min(np.abs(single)) > 0.5
    assert derivative(0, 1) == pytest.approx(sum(single), rel=1e-3)


def test_modes_without_attached_parameters(variant: str) -> None:
    scene, integrator = small_scene(), shadowmap()
    params = mi.traverse(scene)
    assert not integrator.render_forward(scene, params).numpy().any()
    integrator.render_backward(scene, params, dr.ones(mi.TensorXf, (SIZE, SIZE, 3)))


@pytest.mark.parametrize("recorded", [False, True])
def test_vertices_that_become_nan_are_named(variant: str, recorded: bool) -> None:
    """A diverged optimisation: the triangles would just be gone, and all derivatives zero."""
    scene, integrator = small_scene(camera=camera(16)), shadowmap(recorded=recorded)
    params = mi.traverse(scene)
    vertices = mi.Float(params["ball.vertex_positions"])
    for value, where in ((np.nan, 7), (np.inf, 3)):
        params["ball.vertex_positions"] = mi.Float(vertices)
        params.update()
        mi.render(scene, params, integrator=integrator)
        broken = vertices.numpy().copy()
        broken[3 * where + 1] = value
        params["ball.vertex_positions"] = mi.Float(broken)
        params.update()
        with pytest.raises(RuntimeError) as error:
            mi.render(scene, params, integrator=integrator)
        assert f"Vertex {where} of shape 'ball' is [" in "".join(traceback.format_exception(error.value))


def test_vertex_normals_that_stay_behind_are_named(variant: str) -> None:
    """Attached vertices alone leave their normals constant, in Mitsuba's integrators too; updated ones follow."""
    scene = small_scene()
    params = mi.traverse(scene)
    slopes = []
    for update in (False, True):
        dr.enable_grad(params["ball.vertex_positions"])
        if update:
            params.update()
        image = mi.render(scene, params, integrator=shadowmap(), spp=4)
        sources._warn_of_normals.cache_clear()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            dr.backward(dr.mean(image))
        said = [str(warning.message) for warning in caught if "leave out its vertex normals" in str(warning.message)]
        assert len(said) == (not update) and all("'ball'" in text and "params.update()" in text for text in said)
        slopes.append(np.array(dr.grad(params["ball.vertex_positions"])))
        params["ball.vertex_positions"] = dr.detach(params["ball.vertex_positions"])
        params.update()
    assert np.abs(slopes[0] - slopes[1]).max() > 0.05 * np.abs(slopes[1]).max()

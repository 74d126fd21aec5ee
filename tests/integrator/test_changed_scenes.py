"""Parameters that change after the first image: an integrator that has seen the scene before renders what a new one does."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from integrator_scenes import camera, floor, shadowmap, small_scene, sun

from shadowmap_dr.scene.changes import fingerprint

FEW = {"area_light_samples": 4, "environment_light_samples": 16}


def image(scene: Any, integrator: Any) -> np.ndarray:
    return np.array(mi.render(scene, integrator=integrator))


def change(scene: Any, key: str, value: Callable[[Any], Any]) -> None:
    params = mi.traverse(scene)
    params[key] = value(params[key])
    params.update()


def assert_noticed(scene: Any, key: str, value: Callable[[Any], Any], **options: Any) -> None:
    """A change changes the image, and an integrator's that has rendered the scene before in the same way as a new one's."""
    used, fresh = (shadowmap(**FEW, **options) for _ in range(2))
    before = image(scene, used)
    change(scene, key, value)
    found, expected = image(scene, used), image(scene, fresh)
    assert np.abs(expected - before).max() > 0.05
    np.testing.assert_allclose(found, expected, atol=1e-4)


def grid() -> Any:
    """A floor of few triangles with neither normals nor texture coordinates."""
    mesh = mi.Mesh("grid", 4, 2, props=checkered())
    params = mi.traverse(mesh)
    params["vertex_positions"] = np.array([-3, -3, 0, 3, -3, 0, 3, 3, 0, -3, 3, 0], np.float32)
    params["faces"] = np.array([0, 1, 2, 0, 2, 3], np.uint32)
    params.update()
    return mesh


def checkered() -> Any:
    props = mi.Properties()
    props["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "checkerboard"}}})
    return props


def test_texture_coordinates_that_come_later(variant: str) -> None:
    assert_noticed(small_scene(floor=grid()), "floor.vertex_texcoords", lambda _: mi.Float([0, 0, 5, 0, 5, 5, 0, 5]))


def test_normals_that_come_later_and_go(variant: str) -> None:
    tilted = np.tile(np.array([0.6, 0, 0.8], np.float32), 4)
    scene = small_scene(floor=grid())
    assert_noticed(scene, "floor.vertex_normals", lambda _: mi.Float(tilted))
    assert_noticed(scene, "floor.vertex_normals", lambda _: mi.Float([]))


@pytest.mark.parametrize("recorded", [False, True])
def test_single_numbers_of_a_colour(variant: str, recorded: bool) -> None:
    """Red stays the same array. The images, and the derivatives by blue, are those of an integrator that has seen no other."""
    scene, used = small_scene(), shadowmap(recorded=recorded)
    params, red = mi.traverse(scene), dr.opaque(mi.Float, 0.5)
    found = []
    for k in range(3):
        for integrator in (used, shadowmap()):
            blue = dr.opaque(mi.Float, 0.5 + k)
            dr.enable_grad(blue)
            params["sun.irradiance.value"] = mi.Color3f(red, red, blue)
            params.update()
            rendered = mi.render(scene, params, integrator=integrator)
            dr.backward(dr.mean(rendered, axis=None))
            found.append((np.array(rendered), float(dr.grad(blue)[0])))
    for (first, slope), (second, expected) in zip(found[::2], found[1::2], strict=True):
        np.testing.assert_allclose(first, second, atol=1e-5)
        assert slope == pytest.approx(expected, rel=1e-4) and expected > 0.01
    assert np.abs(found[0][0] - found[-1][0]).max() > 0.2


def test_a_sphere_that_is_mirrored(variant: str) -> None:
    """Mitsuba turns its normals over."""
    place = mi.ScalarTransform4f().translate([0, 0, 0.9])
    scene = small_scene(ball={"type": "sphere", "to_world": place @ mi.ScalarTransform4f().scale(0.5)})
    assert_noticed(scene, "ball.to_world", lambda _: mi.Transform4f(place @ mi.ScalarTransform4f().scale([-0.5, 0.5, 0.5])))


@pytest.mark.parametrize("kind", ["rectangle", "disk", "cylinder"])
def test_lamps_that_are_mirrored_and_no_longer(variant: str, kind: str) -> None:
    """Light comes from the same side; a cylinder's changes sides with its normals."""
    place = mi.ScalarTransform4f().look_at([-2, 0, 2], [0, 0, 0], [0, 1, 0])
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": 10.0}}
    lamp = {"type": kind, "to_world": place @ mi.ScalarTransform4f().scale(0.4), "emitter": emitter}
    scene = small_scene(sun=None, lamp=lamp)
    used = shadowmap(**FEW)
    for side in (0.4, -0.4, 0.4, -0.4):
        change(scene, "lamp.to_world", lambda _: mi.Transform4f(place @ mi.ScalarTransform4f().scale([side, 0.4, 0.4])))  # noqa: B023
        found = image(scene, used)
        assert found.mean() > 0.02
        np.testing.assert_allclose(found, image(scene, shadowmap(**FEW)), atol=1e-4)
        direct = np.array(mi.render(scene, integrator=mi.load_dict({"type": "direct"}), spp=64))
        assert found.mean() == pytest.approx(direct.mean(), rel=0.05)


def test_objects_that_leave_an_orthographic_cameras_neighbourhood(variant: str) -> None:
    to_world = camera()["to_world"]
    seen = {**camera(), "type": "orthographic", "to_world": to_world @ mi.ScalarTransform4f().scale([2, 2, 1])}
    del seen["fov"]
    scene = small_scene(camera=seen, floor=None)
    along = np.array(to_world.matrix)[:3, 2]
    used, fresh = shadowmap(), shadowmap()
    before = image(scene, used)
    for by in (40, 4000):
        change(scene, "ball.vertex_positions", lambda v, by=by: v + mi.Float(np.tile(by * along, dr.width(v) // 3)))
        found = image(scene, used)
        np.testing.assert_allclose(found, image(scene, fresh), atol=1e-3)
        assert found.mean() == pytest.approx(before.mean(), rel=0.02)  # parallel light, parallel rays


def turned(value: Any) -> Any:
    return mi.ScalarTransform3f().scale(0.4) @ mi.ScalarTransform3f().translate([0.1, 0.2])


def bitmap(channels: int = 3) -> dict[str, Any]:
    return {"type": "bitmap", "raw": True, "data": mi.TensorXf(np.random.default_rng(0).uniform(0, 1, (8, 8, channels)))}


def spot(**changes: Any) -> dict[str, Any]:
    return {"type": "projector", "to_world": mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]), **changes}


@pytest.mark.parametrize(
    ("name", "key", "value"),
    [
        ("texture", "floor.bsdf.reflectance.to_uv", turned),
        ("bump", "floor.bsdf.scale", lambda v: v * 0.2),
        ("bump", "floor.bsdf.nested_texture.data", lambda v: mi.TensorXf(np.array(v)[::-1] * 0.2)),
        ("plastic", "floor.bsdf.eta", lambda v: v * 1.5),
        ("sky", "sky.sky_scale", lambda v: v * 0.3),
        ("sky", "sky.turbidity", lambda v: v * 1.6),
        ("projector", "light.irradiance.to_uv", turned),
    ],
)
def test_recordings_do_not_hold_for_other_values(variant: str, name: str, key: str, value: Callable[[Any], Any]) -> None:
    """These are no arrays that Dr.Jit would compare."""
    parts: dict[str, dict[str, Any]] = {
        "texture": {"floor": floor(bsdf={"type": "diffuse", "reflectance": bitmap()})},
        "bump": {"floor": floor(bsdf={"type": "bumpmap", "texture": bitmap(1), "bsdf": {"type": "diffuse"}})},
        "plastic": {"floor": floor(bsdf={"type": "plastic"})},
        "sky": {"sky": {"type": "sunsky", "sun_direction": [0.3, 0.3, 0.8]}, "sun": None},
        "projector": {"light": spot(irradiance=bitmap())},
    }
    scene = small_scene(camera=camera(32), **parts[name])
    recorded, plain = (shadowmap(recorded=on, soft_map_resolution=32, **FEW) for on in (True, False))
    for _ in range(4):  # until it replays
        image(scene, recorded)
    for _ in range(2):
        before = image(scene, plain)
        change(scene, key, value)
        found, expected = image(scene, recorded), image(scene, plain)
        np.testing.assert_allclose(found, expected, atol=1e-4)
        if key.endswith("to_uv"):
            break  # the same once more
        assert np.abs(expected - before).max() > 5e-3


def test_lobes_that_are_switched_on_at_zero(variant: str) -> None:
    """To Mitsuba, a ``principled`` whose ``spec_trans`` is 0 anew spreads light to its other side: skies below floors count."""
    scene = small_scene(camera=camera(32), floor=floor(bsdf={"type": "principled"}), sky={"type": "constant"}, sun=None)
    recorded, plain = (shadowmap(recorded=on, soft_map_resolution=32, environment_light_samples=8) for on in (True, False))
    for _ in range(4):
        image(scene, recorded)
    before = image(scene, plain)
    change(scene, "floor.bsdf.spec_trans.value", lambda v: mi.Float(v) + dr.opaque(mi.Float, 0))
    expected = image(scene, plain)
    np.testing.assert_allclose(image(scene, recorded), expected, atol=1e-4)
    assert np.abs(expected - before).max() > 5e-3


def test_unchanged_scenes_stay_recorded(variant: str) -> None:
    scene = small_scene(floor=floor(bsdf={"type": "bumpmap", "texture": bitmap(1), "bsdf": {"type": "plastic"}}), sun=sun())
    integrator = shadowmap(recorded=True)
    counts = []
    for step in range(6):
        change(scene, "ball.vertex_positions", lambda v, step=step: v + 0.01 * step)
        image(scene, integrator)
        counts.append(sum(record.recorded.recordings for record in integrator.shell.scenes))
    assert counts[3:] == 3 * counts[3:4] and counts[0] == 1


def test_fingerprints_are_those_of_one_array(variant: str) -> None:
    """Dr.Jit gives the numbers of arrays that are gone to new ones."""
    array = mi.TensorXf(np.zeros((2, 3), np.float32))
    first = fingerprint(array)
    assert first == fingerprint(array) == fingerprint(mi.TensorXf(array))
    del array
    for k in range(50):
        other = mi.Float([k])
        assert fingerprint(other) != first
        del other
    T = mi.ScalarTransform3f
    for one, two in ((1.0, 1.0 + 1e-15), (T(), T().scale(1.0001)), (True, False), (mi.Vector3f(1, 2, 3), mi.Vector3f(1, 2, 4))):
        assert fingerprint(one) == fingerprint(one) != fingerprint(two)


def lamp(place: Any, kind: str = "rectangle") -> dict[str, Any]:
    return {"type": kind, "to_world": place, "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 8.0}}}


@pytest.mark.parametrize("options", [{}, {"emitter_shadows": "single"}, {"recorded": True}])
def test_lamps_that_move_far_with_everything(variant: str, options: dict[str, Any]) -> None:
    """Their maps face what casts shadows."""
    T = mi.ScalarTransform4f
    down = T().translate([0, 0, 3]) @ T().rotate([1, 0, 0], 180) @ T().scale(0.4)
    scene, away = small_scene(sun=None, lamp=lamp(down)), T().translate([30, 0, 0])
    used, fresh = (shadowmap(**FEW, **options) for _ in range(2))
    before = image(scene, used)
    params = mi.traverse(scene)
    for key, place in (("lamp", down), ("floor", floor()["to_world"]), ("camera", camera()["to_world"])):
        params[f"{key}.to_world"] = mi.Transform4f(away @ place)
    params["ball.vertex_positions"] = params["ball.vertex_positions"] + mi.Float(np.tile([30, 0, 0], 162))
    params.update()
    found = image(scene, used)
    np.testing.assert_allclose(found, image(scene, fresh), atol=1e-4)
    np.testing.assert_allclose(found, before, atol=0.02 * before.max())


def test_lamps_that_come_to_stand_among_objects(variant: str) -> None:
    T = mi.ScalarTransform4f
    posts = {
        f"post_{k}": {"type": "cube", "to_world": T().translate([x, 0, 0.4]) @ T().scale([0.2, 0.4, 0.4])}
        for k, x in enumerate((-1, 1))
    }
    scene = small_scene(ball=None, sun=None, lamp=lamp(T().translate([0, 0, 6]) @ T().scale(0.15), "sphere"), **posts)
    assert_noticed(scene, "lamp.to_world", lambda _: mi.Transform4f(T().translate([0, 0, 0.5]) @ T().scale(0.15)))


def test_a_sky_in_which_a_sun_appears(variant: str) -> None:
    def sunny(data: Any) -> Any:
        values = np.array(data)
        values[3, 9] = 400
        return mi.TensorXf(values)

    dull = mi.Bitmap(np.full((16, 32, 3), 0.5, np.float32))
    upright = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    scene = small_scene(sun=None, sky={"type": "envmap", "bitmap": dull, "to_world": upright})
    assert_noticed(scene, "sky.data", sunny)


def test_small_changes_of_lamps_and_skies_keep_what_was_planned(variant: str) -> None:
    """Derivatives are those of an image that changes smoothly."""
    T = mi.ScalarTransform4f
    bright = mi.Bitmap(np.random.default_rng(0).uniform(0.2, 1, (16, 32, 3)).astype(np.float32))
    down = T().translate([0, 0, 3]) @ T().rotate([1, 0, 0], 180) @ T().scale(0.4)
    scene = small_scene(sun=None, sky={"type": "envmap", "bitmap": bright}, lamp=lamp(down))
    integrator = shadowmap(**FEW)
    image(scene, integrator)
    record = integrator.shell.scenes[0]
    change(scene, "sky.data", lambda data: data * mi.TensorXf(np.random.default_rng(1).uniform(0.9, 1.1, data.shape)))
    change(scene, "lamp.to_world", lambda _: mi.Transform4f(T().translate([0.3, 0.2, 0]) @ down))
    change(scene, "sky.to_world", lambda _: mi.Transform4f(T().rotate([0, 1, 0], 50)))
    image(scene, integrator)
    assert integrator.shell.scenes[0] is record and len(integrator.shell.scenes) == 1

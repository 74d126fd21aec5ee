"""Records of a scene for recordings: read again where parameters have changed, and only there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from integrator_scenes import camera, small_scene, sun

from shadowmap_dr.integrator.parameter_state import ParameterState
from shadowmap_dr.integrator.scene_cache import SceneState
from shadowmap_dr.integrator.scene_reader import SceneReader
from shadowmap_dr.scene.load import PARTS, SceneData, load, refresh
from shadowmap_dr.scene.sensor import sensors_of


class Reading:
    """A scene that is read again and again."""

    def __init__(self, scene: mi.Scene) -> None:
        self.scene, self.params, self.reader = scene, mi.traverse(scene), SceneReader()
        self.data = load(scene)
        self.data = replace(self.data, sensors=(sensors_of(scene.sensors()[0]), *self.data.sensors))

    def read(self, sensor: mi.Sensor | None = None) -> SceneData:
        sensor = sensor or self.scene.sensors()[0]
        now = SceneState.of(self.scene, sensor, ParameterState.of(self.scene))
        return self.reader.read(self.data, sensor, now.scene, now.camera)

    def fresh(self) -> SceneData:
        """The same without a memory."""
        return refresh(self.data, sensors=(self.scene.sensors()[0],))


def move_ball(params: Any) -> None:
    params["ball.vertex_positions"] = params["ball.vertex_positions"] + 0.1


def turn_floor(params: Any) -> None:
    params["floor.to_world"] = mi.Transform4f().rotate([0, 0, 1], 10) @ params["floor.to_world"]


def turn_sun(params: Any) -> None:
    params["sun.to_world"] = mi.Transform4f().rotate([0, 1, 0], 10) @ params["sun.to_world"]


def brighten(params: Any) -> None:
    params["sun.irradiance.value"] = mi.Float(2.5)


def zoom(params: Any) -> None:
    params["camera.x_fov"] = mi.Float(33)


def crop(params: Any) -> None:
    params["camera.film.crop_size"] = [20, 16]


def paint(params: Any) -> None:
    params["ball.bsdf.reflectance.value"] = mi.Float(0.1)


def numbers(data: SceneData, part: str) -> list[np.ndarray]:
    fields = {
        "geometry": lambda: [data.geometry.positions, data.geometry.normals],
        "lights": lambda: [v for light in data.lights for v in vars(light).values() if dr.is_array_v(v)],
        "sensors": lambda: [v for (one,) in data.sensors[:1] for v in (one.to_world.matrix, one.x_fov)],
    }
    return [np.array(dr.detach(array)) for array in fields[part]()]


@pytest.mark.parametrize(
    ("change", "part"),
    [
        (move_ball, "geometry"),
        (turn_floor, "geometry"),
        (turn_sun, "lights"),
        (brighten, "lights"),
        (zoom, "sensors"),
        (crop, "sensors"),
        (paint, None),
    ],
)
def test_parts_stay_until_they_change(variant: str, change: Callable[[Any], None], part: str | None) -> None:
    reading = Reading(small_scene(sun=sun(irradiance={"type": "rgb", "value": 1.0})))
    first, again = reading.read(), reading.read()
    assert all(getattr(first, name) is getattr(again, name) for name in PARTS)
    change(reading.params)
    reading.params.update()
    now, fresh = reading.read(), reading.fresh()
    for name in PARTS:
        assert (getattr(now, name) is getattr(first, name)) == (name != part)
        for value, wanted in zip(numbers(now, name), numbers(fresh, name), strict=True):
            np.testing.assert_array_equal(value, wanted)
    assert now.sensors[0][0].crop_size == fresh.sensors[0][0].crop_size


def test_sensors_in_turns(variant: str) -> None:
    aside = {**camera(), "to_world": mi.ScalarTransform4f().look_at([3, -3, 2.2], [0, 0, 0.5], [0, 0, 1])}
    reading = Reading(small_scene(aside=aside))
    foreign = mi.load_dict(aside | {"fov": 20})
    for sensor in (*reading.scene.sensors(), foreign, reading.scene.sensors()[0]):
        data = reading.read(sensor)
        np.testing.assert_array_equal(data.sensors[0][0].x_fov, sensors_of(sensor)[0].x_fov)
        np.testing.assert_array_equal(data.sensors[0][0].to_world.matrix, sensors_of(sensor)[0].to_world.matrix)
        assert len(data.sensors) == 1
    params = mi.traverse(foreign)
    assert reading.read(foreign).sensors[0][0].x_fov[0] == pytest.approx(20)
    params["x_fov"] = mi.Float(25)
    params.update()
    assert reading.read(foreign).sensors[0][0].x_fov[0] == pytest.approx(25)


def test_attached_parts_are_read_each_time(variant: str) -> None:
    """They belong to the graph of one image. Nothing that stays carries gradients."""
    reading = Reading(small_scene())
    before = reading.read()
    x = mi.Float(0)
    dr.enable_grad(x)
    reading.params["sun.to_world"] = mi.Transform4f().rotate([0, 1, 0], x) @ reading.params["sun.to_world"]
    reading.params.update()
    first, second = reading.read(), reading.read()
    assert first.lights is not second.lights and dr.grad_enabled(second.lights[0].direction)
    assert first.geometry is before.geometry and first.sensors is before.sensors
    assert reading.reader.fields(second) == ("lights",)
    assert not any(dr.grad_enabled(part.records) for part in reading.reader._parts.values())
    reading.params["sun.to_world"] = mi.Transform4f(dr.detach(reading.params["sun.to_world"].matrix))
    reading.params.update()
    assert not dr.grad_enabled(reading.read().lights[0].direction)


def test_lights_of_shapes_follow_them(variant: str) -> None:
    """A beam shines from a shape, which moves it."""
    beam = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 3], [0.2, 0, 0], [0, 1, 0]),
        "emitter": {"type": "directionalarea", "radiance": {"type": "rgb", "value": 2.0}},
    }
    reading = Reading(small_scene(beam=beam))
    first = reading.read()
    reading.params["beam.to_world"] = mi.Transform4f().translate([0.3, 0, 0]) @ reading.params["beam.to_world"]
    reading.params.update()
    now, fresh = reading.read(), reading.fresh()
    assert now.lights is not first.lights
    for value, wanted in zip(numbers(now, "lights"), numbers(fresh, "lights"), strict=True):
        np.testing.assert_array_equal(value, wanted)


def test_textures_of_lights_that_walls_show_too(variant: str) -> None:
    """Mitsuba lists a texture once, with the first object that names it."""
    pixels = np.random.default_rng(0).uniform(0.2, 0.8, (4, 4, 3)).astype(np.float32)
    texture = {"type": "bitmap", "id": "picture", "bitmap": mi.Bitmap(pixels), "raw": True}
    scene = small_scene(
        picture=texture,
        floor={"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": {"type": "ref", "id": "picture"}}},
        projector={"type": "projector", "irradiance": {"type": "ref", "id": "picture"}, "fov": 40.0},
    )
    reading = Reading(scene)
    first = reading.read()
    (name,) = (name for name in reading.params.keys() if name.endswith(".data"))
    reading.params[name] = mi.TensorXf(pixels[::-1].copy())
    reading.params.update()
    now = reading.read()
    assert now.lights is not first.lights and now.geometry is first.geometry

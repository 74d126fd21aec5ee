"""Camera records against Mitsuba's own rays."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr import ShadowmapError
from shadowmap_dr.cameras import from_sensor
from shadowmap_dr.scene.load import load
from shadowmap_dr.scene.sensor import sensors_of


def film(**settings: Any) -> dict[str, Any]:
    return {"type": "hdrfilm", "width": 40, "height": 30, "rfilter": {"type": "box"}, **settings}


def look_at() -> Any:
    return mi.ScalarTransform4f().look_at([-3, 2, 4], [0, 0.3, -1], [0, 1, 0])


CROP = {"crop_offset_x": 7, "crop_offset_y": 4, "crop_width": 21, "crop_height": 13}
CAMERAS: dict[str, Any] = {
    "perspective": lambda: {"type": "perspective", "fov": 45, "to_world": look_at(), "film": film()},
    "fov_axis": lambda: {"type": "perspective", "fov": 45, "fov_axis": "y", "to_world": look_at(), "film": film()},
    "crop": lambda: {
        "type": "perspective",
        "fov": 35,
        "principal_point_offset_x": 0.13,
        "principal_point_offset_y": -0.07,
        "to_world": look_at(),
        "film": film(**CROP),
    },
    "orthographic": lambda: {
        "type": "orthographic",
        "to_world": look_at() @ mi.ScalarTransform4f().scale([2, 3, 1]),
        "film": film(**CROP),
    },
}


@pytest.mark.parametrize("along", [0.25, 1.0, 4.0])
def test_far_plane_of_a_scaled_orthographic_camera(variant: str, along: float) -> None:
    to_world = look_at() @ mi.ScalarTransform4f().scale([2, 2, along])
    sensor = mi.load_dict({"type": "orthographic", "to_world": to_world, "near_clip": 0.5, "far_clip": 9, "film": film()})
    (record,) = sensors_of(sensor)
    ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(0.3, 0.6), mi.Point2f(0.5))
    ends = [to_ndc(record, ray(t)).z[0] for t in (0.0, ray.maxt)]
    assert np.allclose(ends, [-1, 1], atol=1e-5)


def to_ndc(sensor: Any, p_world: Any) -> Any:
    clip = sensor.view_projection @ mi.Vector4f(p_world.x, p_world.y, p_world.z, 1.0)
    return clip / clip.w


@pytest.mark.parametrize("camera", CAMERAS)
def test_projection_inverts_mitsuba_rays(variant: str, camera: str) -> None:
    sensor = mi.load_dict(CAMERAS[camera]())
    (record,) = sensors_of(sensor)
    rng = np.random.default_rng(1)
    position = mi.Point2f(rng.random((2, 64)))
    ray, _ = sensor.sample_ray(0.0, 0.5, position, mi.Point2f(0.5))
    p_world = ray(mi.Float(rng.random(64) * 5 + 1))
    ndc = to_ndc(record, p_world)
    assert np.allclose(ndc.xy.numpy(), 2 * position.numpy() - 1, atol=1e-5)
    assert np.all(np.abs(ndc.z.numpy()) < 1)
    assert np.allclose(record.wi_world(p_world).numpy(), -ray.d.numpy(), atol=1e-5)


@pytest.mark.parametrize("camera", CAMERAS)
def test_pixel_centres_and_rows(variant: str, camera: str) -> None:
    sensor = mi.load_dict(CAMERAS[camera]())
    (record,) = sensors_of(sensor)
    index = np.arange(record.width * record.height)
    centre = np.stack([(index % record.width + 0.5) / record.width, (index // record.width + 0.5) / record.height])
    ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(centre), mi.Point2f(0.5))
    assert np.allclose(record.ray_direction().numpy(), ray.d.numpy(), atol=1e-6)


def test_batch(variant: str) -> None:
    batch = mi.load_dict(
        {
            "type": "batch",
            "film": film(width=60, height=20, pixel_format="luminance_alpha"),
            "a": {"type": "perspective", "fov": 45, "to_world": look_at()},
            "b": {"type": "orthographic", "to_world": look_at()},
            "c": {"type": "perspective", "fov": 30},
        }
    )
    records = sensors_of(batch)
    assert [r.name for r in records] == ["a", "b", "c"]
    assert [r.film_column for r in records] == [0, 20, 40]
    rng = np.random.default_rng(2)
    for i, record in enumerate(records):
        assert (record.width, record.height, record.channels, record.alpha) == (20, 20, 1, True)
        position = mi.Point2f(rng.random((2, 64)))
        ray, _ = batch.sample_ray(0.0, 0.5, mi.Point2f((position.x + i) / 3, position.y), mi.Point2f(0.5))
        ndc = to_ndc(record, ray(mi.Float(rng.random(64) * 5 + 1)))
        assert np.allclose(ndc.xy.numpy(), 2 * position.numpy() - 1, atol=1e-5)


@pytest.mark.parametrize("field", ["angle", "x_fov", "principal_point"])
def test_gradients(variant: str, field: str) -> None:
    (record,) = sensors_of(mi.load_dict(CAMERAS["crop"]()))
    p_world = mi.Point3f([0.1, 0.4], [-0.2, 0.3], [0.0, -1.0])

    def project(x: Any) -> Any:
        if field == "angle":
            moved = replace(record, to_world=record.to_world @ mi.Transform4f().rotate([0.3, 1, 0.2], x))
        elif field == "x_fov":
            moved = replace(record, x_fov=x)
        else:
            moved = replace(record, principal_point=mi.Point2f(x, 2 * x))
        ndc = to_ndc(moved, p_world)
        return dr.sum(ndc.x + 2 * ndc.y + moved.wi_world(p_world).x)

    start = {"angle": 1.0, "x_fov": 35.0, "principal_point": 0.1}[field]
    x = mi.Float(start)
    dr.enable_grad(x)
    dr.backward(project(x))
    step = 1e-2
    difference = (project(mi.Float(start + step)) - project(mi.Float(start - step))) / (2 * step)
    assert np.allclose(x.grad.numpy(), difference.numpy(), rtol=5e-3, atol=1e-4)


def test_unsupported_sensor_is_named(variant: str) -> None:
    one_pixel = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    scene = mi.load_dict({"type": "scene", "probe": {"type": "distant", "film": one_pixel}})
    with pytest.raises(ShadowmapError, match="'probe'"):
        sensors_of(scene.sensors()[0])


def test_unsupported_film_is_named(variant: str) -> None:
    """In the scene, as a first image's own camera, and as one of later images, recorded or not."""
    eye = {"type": "perspective", "film": film(pixel_format="xyz")}
    ball: dict[str, object] = {"type": "scene", "ball": {"type": "sphere"}, "sun": {"type": "directional"}}
    with pytest.raises(ShadowmapError, match="'eye'.*rgb"):
        load(mi.load_dict(ball | {"eye": eye}))
    scene = mi.load_dict(ball | {"near": {"type": "perspective", "film": film()}})
    foreign = mi.load_dict({"type": "scene", "eye": eye}).sensors()[0]
    with pytest.raises(ShadowmapError, match="'eye'.*rgb"):
        from_sensor(foreign)
    for recorded in (False, True):
        integrator = mi.load_dict({"type": "shadowmap", "recorded": recorded})
        for _ in range(2):
            with pytest.raises(ShadowmapError, match="'eye'.*rgb"):
                integrator.render(scene, sensor=foreign)
            integrator.render(scene)

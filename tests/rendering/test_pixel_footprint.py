"""Spots that a pixel looks at, against rays of Mitsuba's cameras, and means over them against sums written out."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr import Renderer
from shadowmap_dr.rendering.gbuffer import pixel_footprint
from shadowmap_dr.rendering.gbuffer.pixel_footprint import FootprintSamples, footprint_points, footprints
from shadowmap_dr.scene.lights.soft_outline import share_inside, softened
from shadowmap_dr.scene.sensor import ImageSize, Sensor, sensors_of

SIZE = 12


def camera(kind: str) -> tuple[Any, Sensor]:
    to_world = mi.ScalarTransform4f().look_at([-2, 1.5, 4], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE + 2, "rfilter": {"type": "box"}}
    description: dict[str, Any] = {"type": "perspective", "fov": 6, "principal_point_offset_x": 0.1, "to_world": to_world}
    if kind == "orthographic":
        description = {"type": "orthographic", "to_world": to_world @ mi.ScalarTransform4f().scale([0.3, 0.25, 1])}
    made = mi.load_dict({**description, "film": film})
    return made, sensors_of(made)[0]


def seen_by(kind: str, sensor: Any) -> tuple[Any, Any, Any]:
    """As the renderer has it: orthographic cameras need no depth."""
    points, normal, depth = seen(sensor)
    return points, normal, depth if kind == "perspective" else None


def seen(sensor: Any, x: float = 0.5, y: float = 0.5) -> tuple[Any, Any, Any]:
    """Mitsuba's rays through places (x, y) of all pixels on a slanted plane: points, the plane's normal, depths."""
    lane = dr.arange(mi.UInt32, SIZE * (SIZE + 2))
    place = mi.Point2f((lane % SIZE + x) / SIZE, (lane // SIZE + y) / (SIZE + 2))
    ray, _ = sensor.sample_ray(mi.Float(0), mi.Float(0), place, mi.Point2f(0.5))
    normal = dr.normalize(mi.Vector3f(0.3, 0.8, 0.6))
    points = ray((0.1 - dr.dot(normal, ray.o)) / dr.dot(normal, ray.d))
    return points, normal + dr.zeros(mi.Vector3f, dr.width(lane)), (sensor.world_transform().inverse() @ points).z


@pytest.mark.parametrize("count", [2, 3])
@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
def test_spots_are_where_rays_through_the_pixel_meet_the_surface(variant: str, kind: str, count: int) -> None:
    mitsuba_sensor, sensor = camera(kind)
    points, normal, depth = seen_by(kind, mitsuba_sensor)
    spots = footprint_points(sensor, ImageSize(SIZE, SIZE + 2), depth, points, normal, count)
    pixel = float(dr.norm(dr.gather(mi.Point3f, points, 1) - dr.gather(mi.Point3f, points, 0))[0])
    for number, spot in enumerate(reversed(spots)):  # from the lower right; a mean does not mind
        wanted, _, _ = seen(mitsuba_sensor, (number % count + 0.5) / count, (number // count + 0.5) / count)
        assert float(dr.max(dr.norm(spot - wanted))[0]) < 0.01 * pixel


@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
def test_spots_lie_on_surfaces_seen_from_the_side(variant: str, kind: str) -> None:
    """Footprints are cut short there."""
    _, sensor = camera(kind)
    points, _, depth = seen_by(kind, camera(kind)[0])
    along = points - sensor.origin if kind == "perspective" else sensor.to_world @ mi.Vector3f(0, 0, 1)
    view = dr.normalize(mi.Vector3f(along))
    side = dr.normalize(dr.cross(view, mi.Vector3f(0.2, 1, 0.1)))
    normal = dr.normalize(side - 0.03 * view)
    for spot in footprint_points(sensor, ImageSize(SIZE, SIZE + 2), depth, points, normal, 2):
        away = spot - points
        assert float(dr.min(dr.norm(away))[0]) > 1e-4
        assert float(dr.max(dr.abs(dr.dot(away, normal)) / dr.norm(away))[0]) < 1e-3


@pytest.mark.parametrize("count", [1, 2, 3, 4])
@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
def test_means_and_their_derivatives_are_those_of_sums_written_out(variant: str, kind: str, count: int) -> None:
    mitsuba_sensor, sensor = camera(kind)
    arguments = sensor, ImageSize(SIZE, SIZE + 2)
    active = dr.arange(mi.UInt32, SIZE * (SIZE + 2)) % 7 > 0

    def curved(points: Any, active: Any) -> Any:
        return dr.select(active, dr.sin(40 * points.x) * dr.exp(points.y) + points.z**2, -1.0)

    def written_out(points: Any, normal: Any, depth: Any) -> Any:
        return sum(curved(p, active) for p in footprint_points(*arguments, depth, points, normal, count)) / count**2

    def mean(points: Any, normal: Any, depth: Any) -> Any:
        return FootprintSamples.of(*arguments, depth, points, normal, active, count).mean(curved)

    results = []
    for function in (written_out, mean):
        points, normal, depth = seen_by(kind, mitsuba_sensor)
        dr.enable_grad(points)
        value = function(points, normal, depth)
        dr.set_grad(points, mi.Vector3f(0.3, -0.5, 0.2))
        dr.enqueue(dr.ADMode.Forward, points)
        dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges | dr.ADFlag.ClearInterior)
        forward = np.array(dr.grad(value))
        points, normal, depth = seen_by(kind, mitsuba_sensor)
        dr.enable_grad(points)
        again = function(points, normal, depth)
        dr.backward(again * dr.linspace(mi.Float, -1, 2, dr.width(again)))
        results.append((np.array(value), forward, np.array(dr.grad(points))))
    for wanted, found in zip(*results, strict=True):
        np.testing.assert_allclose(found, wanted, atol=2e-6 * np.abs(wanted).max())
    assert np.abs(results[0][1]).max() > 1


def test_many_spots_are_one_array(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """As arrays of their own, nine look-ups would be compiled nine times. Of a large image they are: memory is dearer."""
    mitsuba_sensor, sensor = camera("perspective")
    points, normal, depth = seen(mitsuba_sensor)

    def spots(count: int) -> FootprintSamples:
        return FootprintSamples.of(sensor, ImageSize(SIZE, SIZE + 2), depth, points, normal, mi.Bool(True), count)

    for count, arrays in ((1, 1), (2, 4), (3, 1), (8, 1)):
        assert len(spots(count).points) == arrays and arrays * spots(count).copies == count**2
    monkeypatch.setattr(pixel_footprint, "_MOST_LANES", 9 * dr.width(points))
    assert (len(spots(3).points), len(spots(4).points)) == (1, 16)


LOOK = {"origin": [0.4, 2.0, 1.5], "target": [0.1, 0.0, 0.0], "up": [0, 0, 1]}
BOUNDED: dict[str, dict[str, Any]] = {
    "spot": {"type": "spot", "cutoff_angle": 3.0, "beam_width": 2.999},
    "soft spot": {"type": "spot", "cutoff_angle": 8.0, "beam_width": 1.0},
    "wide spot": {"type": "spot", "cutoff_angle": 88.0, "beam_width": 87.9},
    "projector": {"type": "projector", "fov": 7.0, "irradiance": {"type": "rgb", "value": 1.0}},
    "rectangle": {"type": "rectangle"},
    "disk": {"type": "disk"},
}


@pytest.mark.parametrize("name", BOUNDED)
@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
def test_outlines_that_are_softened_beside_them_alone(variant: str, kind: str, name: str) -> None:
    """Shares of light are those of ramps measured at all pixels; pixels are smaller and larger than the outline's distance."""
    mitsuba_sensor, sensor = camera(kind)
    points, normal, depth = seen_by(kind, mitsuba_sensor)
    description = {**BOUNDED[name], "to_world": mi.ScalarTransform4f().look_at(**LOOK)}
    if name in ("rectangle", "disk"):
        description["to_world"] = description["to_world"] @ mi.ScalarTransform4f().scale([0.13, 0.07, 1])
        description["glow"] = {"type": "directionalarea", "radiance": 1.0}
    if name == "wide spot":
        # Close to the plane, along which it looks.
        description["to_world"] = mi.ScalarTransform4f().look_at([0.005, 0.15, 0.01], [0.942, -0.2, 0.01], [0, 0, 1])
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere"}, "sensor": mitsuba_sensor, "light": description})
    (light,) = Renderer.from_scene(scene).data.lights
    within = 0
    for scale in (0.1, 1, 10):
        size = ImageSize(round(SIZE * scale), round((SIZE + 2) * scale))
        expected = share_inside(light, points, footprint_points(sensor, size, depth, points, normal, 2)).numpy()
        (soft,) = softened([light], points, lambda size=size: footprints(sensor, size, depth, normal))
        np.testing.assert_allclose(soft.inside.numpy(), expected, atol=1e-6)
        within += np.count_nonzero((expected > 0.01) & (expected < 0.99))
    assert within > 10, "the outline is somewhere in the picture"

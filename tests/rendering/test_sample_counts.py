"""``area_light_samples="auto"``: as many points on a lamp as its penumbrae have pixels."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr import Renderer, ShadowmapError
from shadowmap_dr.rendering.extended_lights.sample_counts import FEWEST, MOST, _pixels, _widths, area_light_count, spread_points

ERROR = 0.01  # of the mean; the docs state it


def scene(radius: float, size: int, kind: str = "sphere", fov: float = 40) -> Any:
    """A cube that floats over a floor, under a round lamp, 3 above the floor."""
    T = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    shine = {"type": "area", "radiance": {"type": "rgb", "value": 1 / radius**2}}
    look = T().look_at([2, -3, 3], [0, 0, 0], [0, 0, 1])
    place = T().translate([0.6, 0.3, 3]) @ (T().rotate([1, 0, 0], 180) if kind == "disk" else T()) @ T().scale(radius)
    return mi.load_dict(
        {
            "type": "scene",
            "camera": {"type": "perspective", "fov": fov, "to_world": look, "film": film},
            "floor": {"type": "rectangle", "to_world": T().scale(3)},
            "box": {"type": "cube", "to_world": T().translate([0, 0, 0.8]).rotate([0, 0, 1], 20).scale(0.3)},
            "lamp": {"type": kind, "to_world": place, "emitter": shine},
        }
    )


def count(renderer: Renderer) -> int:
    (plan,) = renderer.soft
    return plan.count


def test_widths_of_penumbrae() -> None:
    """By similar triangles."""
    receivers = np.array([[0.0, 0, -4], [0, 0, -2], [3, 0, -4], [0, 0, -1]])
    blockers = np.array([[0.0, 0, -1], [0.1, 0, -1.6]])
    np.testing.assert_allclose(_widths(blockers, receivers, 0.5), [3, 1, 0, 0], atol=1e-12)


def test_pixels_of_penumbrae(variant: str) -> None:
    """A camera 4 above the floor whose film shows 2 tan(20 degrees) of each unit of depth."""
    T = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 100, "height": 60, "rfilter": {"type": "box"}}
    look = T().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    parts = {"type": "scene", "floor": {"type": "rectangle"}}
    views = {
        "near": {"type": "perspective", "fov": 40, "to_world": look, "film": film},
        "flat": {"type": "orthographic", "to_world": look @ T().scale([2, 2, 1]), "film": film},
    }
    renderer = Renderer.from_dict({**parts, **views})
    points, widths = np.array([[0.0, 0, 0], [50, 0, 0]]), np.array([0.5, 9.0])  # the second is out of sight
    found = [_pixels(cameras[0], points, widths) for cameras in renderer.data.sensors]
    np.testing.assert_allclose(found, [0.5 * 100 / (2 * 4 * np.tan(np.radians(20))), 0.5 * 100 / 4], rtol=1e-5)
    assert _pixels(renderer.data.sensors[0][0], points, np.zeros(2)) == 0


def test_points_are_spread_by_area() -> None:
    corners = np.array([[[0.0, 0, 0], [3, 0, 0], [0, 1, 0]], [[10, 0, 0], [11, 0, 0], [10, 1, 0]], [[5, 5, 5]] * 3])
    positions, faces = corners.reshape(-1, 3).astype(np.float32), np.arange(9, dtype=np.uint32).reshape(3, 3)
    points, face = spread_points(positions, faces, 400)
    assert points.shape == (400, 3) and (points[:, 0] < 5).sum() == 300 == (face == 0).sum()
    inside = points[points[:, 0] < 5]
    assert (inside >= 0).all() and (inside[:, 0] / 3 + inside[:, 1] <= 1).all()
    np.testing.assert_array_equal(spread_points(positions, faces[2:])[0], corners[2:, 0])


@pytest.mark.parametrize("kind", ["sphere", "disk"])
def test_larger_lamps_and_closer_cameras_need_more(variant: str, kind: str) -> None:
    counts = [count(Renderer.from_scene(scene(radius, 64, kind))) for radius in (0.01, 0.1, 0.3)]
    assert counts[0] == FEWEST and counts[-1] > FEWEST and counts == sorted(counts)
    assert count(Renderer.from_scene(scene(0.3, 512, kind))) == MOST
    assert count(Renderer.from_scene(scene(0.1, 64, kind, fov=5))) == MOST
    assert count(Renderer.from_scene(scene(0.3, 64, kind), area_light_samples=5)) == 5


@pytest.mark.parametrize(("radius", "size", "kind"), [(0.02, 64, "sphere"), (0.15, 64, "sphere"), (0.1, 128, "disk")])
def test_error(variant: str, radius: float, size: int, kind: str) -> None:
    """Against 256 points."""
    made = scene(radius, size, kind)
    image, reference = (Renderer.from_scene(made, area_light_samples=n).render(spp=4).numpy() for n in ("auto", 256))
    assert count(Renderer.from_scene(made)) < 32
    assert np.sqrt(np.square(image - reference).mean()) < ERROR * reference.mean()


def test_the_plugin_looks_at_all_cameras(variant: str) -> None:
    """Not at the one alone that is rendered first."""
    T = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 64, "height": 64, "rfilter": {"type": "box"}}
    views = [
        {"type": "perspective", "fov": fov, "to_world": T().look_at([2, -3, 3], [0, 0, 0], [0, 0, 1]), "film": film}
        for fov in (60, 6)
    ]
    lamp = {"type": "sphere", "center": [0.6, 0.3, 3], "radius": 0.05, "emitter": {"type": "area"}}
    box = {"type": "cube", "to_world": T().translate([0, 0, 0.8]).scale(0.3)}
    floor = {"type": "rectangle", "to_world": T().scale(3)}
    counts = []
    for cameras in (views[:1], views):
        parts = {f"camera{k}": camera for k, camera in enumerate(cameras)}
        made, integrator = (
            mi.load_dict({"type": "scene", "floor": floor, "box": box, "lamp": lamp, **parts}),
            mi.load_dict({"type": "shadowmap"}),
        )
        mi.render(made, integrator=integrator)
        counts.append(count(integrator.shell.scenes[0].renderer))
    assert counts[0] == FEWEST and counts[1] > FEWEST


def test_near_lamps_need_more(variant: str) -> None:
    """Also where penumbrae are narrow: their parts are seen under large angles."""
    renderer = Renderer.from_scene(scene(0.1, 16))
    cameras = [camera for cameras in renderer.data.sensors for camera in cameras]
    lamp = np.array([[0.1, 0, 0], [-0.1, 0, 0]])
    away = np.array([[0.0, 0, 9]])
    counts = [area_light_count(lamp, [away], np.array([[0.0, 0, -d]]), cameras) for d in (0.05, 0.5, 0.8, 1.05, 2)]
    assert counts == [MOST, MOST, MOST, 16, FEWEST]


def test_nothing_to_see(variant: str) -> None:
    """No casters in view, a lamp without extent, no cameras."""
    renderer = Renderer.from_scene(scene(0.1, 32))
    cameras = [camera for cameras in renderer.data.sensors for camera in cameras]
    lamp, floor = np.array([[0.0, 0, 3], [0, 0, 3.1]]), np.array([[0.0, 0, 0], [1, 0, 0]])
    assert area_light_count(lamp, [floor + [0, 0, 10]], floor, cameras) == FEWEST
    assert area_light_count(lamp[:1], [floor + [0, 0, 1]], floor, cameras) == FEWEST
    assert area_light_count(lamp, [floor + [0, 0, 1]], floor, []) == MOST
    assert area_light_count(lamp, [floor + [0, 0, 1]], floor[:0], cameras) == FEWEST


@pytest.mark.parametrize("value", ["many", 0, 1.5])
def test_other_values_are_named(variant: str, value: Any) -> None:
    with pytest.raises(ShadowmapError, match="area_light_samples is"):
        Renderer.from_scene(scene(0.1, 16), area_light_samples=value)

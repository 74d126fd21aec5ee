"""Scenes that are changed for a while, and Mitsuba's images of them."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
import pytest
from fitting_scenes import OPTIONS, box, camera, diffuse, renderer_of, rgb, scene_of, sun, varied_scene

from shadowmap_dr import Renderer
from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.fitting.changes import Changes
from shadowmap_dr.fitting.reference import Reference
from shadowmap_dr.fitting.resolve import Resolver
from shadowmap_dr.fitting.scene_update import updated
from shadowmap_dr.fitting.vary import Vary
from shadowmap_dr.fitting.views import Quality, View
from shadowmap_dr.scene.sensor import ImageSize, Sensor

Image = npt.NDArray[np.float32]


def T() -> Any:
    return mi.ScalarTransform4f()


@pytest.fixture(autouse=True)
def one_backend() -> None:
    """Mitsuba renders: both backends have the same objects."""
    mi.set_variant("llvm_ad_rgb")


def values_of(scene: mi.Scene) -> dict[str, npt.NDArray[Any]]:
    """All parameters of a scene, by name."""
    found = {}
    for key, value in mi.traverse(scene):
        matrix = getattr(value, "matrix", value)
        if dr.is_array_v(matrix) or isinstance(matrix, (int, float)):
            found[key] = np.array(dr.detach(matrix) if dr.is_array_v(matrix) else matrix)
    return found


def photograph(scene: mi.Scene, spp: int = 256) -> Image:
    return np.array(mi.render(scene, integrator=mi.load_dict({"type": "direct"}), spp=spp), np.float32)[..., :3]


def rotated(degrees: float, x: float = 0, y: float = 0, z: float = 0) -> Any:
    return T().translate([x, y, z]) @ T().rotate([0.3, 0.2, 1], degrees)


def matrix_of(transform: Any) -> npt.NDArray[np.float64]:
    return np.array(transform.matrix, np.float64)


# Parts of a scene, the same parts after a change, and the change.
CHANGED: dict[str, Any] = {
    "mesh": lambda: (
        {"box": box(0)},
        {"box": {**box(0), "to_world": rotated(30, 0.2, 0.1, 0.1) @ box(0)["to_world"]}},
        Changes(transforms={"box": matrix_of(rotated(30, 0.2, 0.1, 0.1))}),
    ),
    "sphere": lambda: (
        {"box": {"type": "sphere", "radius": 0.5, "bsdf": diffuse(0.7, 0.5, 0.3)}},
        {"box": {"type": "sphere", "radius": 0.5, "center": [0.3, 0.2, 0.1], "bsdf": diffuse(0.7, 0.5, 0.3)}},
        Changes(transforms={"box": matrix_of(T().translate([0.3, 0.2, 0.1]))}),
    ),
    "instance": lambda: (
        {"box": None, "group": {"type": "shapegroup", "one": box(0)}, "copy": {"type": "instance", "shapegroup": REFERENCE}},
        {
            **{"box": None, "group": {"type": "shapegroup", "one": box(0)}},
            "copy": {"type": "instance", "shapegroup": REFERENCE, "to_world": rotated(20, 0.1, 0, 0)},
        },
        Changes(transforms={"copy.one": matrix_of(rotated(20, 0.1, 0, 0))}),
    ),
    "rectangle": lambda: (
        {"sun": None, "panel": panel(T())},
        {"sun": None, "panel": panel(T().translate([0.4, 0, 0.3]))},
        Changes(transforms={"panel": matrix_of(T().translate([0.4, 0, 0.3]))}),
    ),
    "values": lambda: (
        {},
        {"box": box(0, 0, 0.1, 0.6, 0.2), "sun": sun(irradiance=rgb(1, 3, 2))},
        Changes(values={"box.bsdf.reflectance.value": np.array([0.1, 0.6, 0.2]), "sun.irradiance.value": np.array([1.0, 3, 2])}),
    ),
    "direction": lambda: (
        {},
        {"sun": {"type": "directional", "to_world": rotated(170), "irradiance": rgb(2.0, 1.5, 1.0)}},
        Changes(values={"sun.to_world": matrix_of(rotated(170))}),
    ),
    "point": lambda: (
        {"sun": None, "lamp": {"type": "point", "position": [0.8, 0.5, 2.8], "intensity": rgb(12, 10, 8)}},
        {"sun": None, "lamp": {"type": "point", "position": [-0.5, 0.9, 2], "intensity": rgb(6)}},
        Changes(values={"lamp.position": np.array([-0.5, 0.9, 2]), "lamp.intensity.value": np.array([6.0, 6, 6])}),
    ),
    "spot": lambda: (
        {"sun": None, "spot": spot(20, 15)},
        {"sun": None, "spot": spot(30, 25)},
        Changes(values={"spot.cutoff_angle": np.array([30.0]), "spot.beam_width": np.array([25.0])}),
    ),
}
REFERENCE = {"type": "ref", "id": "group"}


def panel(moved: Any) -> dict[str, Any]:
    place = moved @ T().translate([0.5, 0.4, 3]) @ T().rotate([1, 0, 0], 180) @ T().scale(0.4)
    return {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": rgb(24, 20, 16)}}


def spot(cutoff: float, beam: float) -> dict[str, Any]:
    to_world = T().look_at([1, 1, 4], [0, 0, 0.3], [0, 1, 0])
    return {"type": "spot", "to_world": to_world, "cutoff_angle": cutoff, "beam_width": beam, "intensity": rgb(20, 18, 15)}


@pytest.mark.parametrize("name", CHANGED)
def test_a_changed_scene_is_the_scene_that_was_made_so(name: str) -> None:
    before, after, changes = CHANGED[name]()
    scene = scene_of(**before)
    data = Renderer.from_scene(scene, **OPTIONS).data
    expected, unchanged = photograph(scene_of(**after)), photograph(scene)
    old = values_of(scene)
    with updated(data, changes) as same:
        found = photograph(same)
    assert np.abs(unchanged - expected).mean() > 0.005
    assert np.abs(found - expected).mean() < 0.1 * np.abs(unchanged - expected).mean()
    new = values_of(scene)
    assert old.keys() == new.keys()
    for key, value in old.items():
        np.testing.assert_array_equal(new[key], value, err_msg=key)


def test_vertices_and_textures_change_for_a_while() -> None:
    scene = varied_scene()
    data = Renderer.from_scene(scene, **OPTIONS).data
    old = values_of(scene)
    points = old["car_body.vertex_positions"].reshape(-1, 3) + np.array([0.1, 0, 0.2])
    texture = 1 - old["floor.bsdf.reflectance.data"]
    with updated(data, Changes(values={"floor.bsdf.reflectance.data": texture}, vertices={"car_body": points})):
        now = values_of(scene)
        np.testing.assert_allclose(now["car_body.vertex_positions"].reshape(-1, 3), points, rtol=1e-6)
        np.testing.assert_allclose(now["floor.bsdf.reflectance.data"], texture, rtol=1e-6)
    for key, value in values_of(scene).items():
        np.testing.assert_array_equal(old[key], value, err_msg=key)


def test_normals_of_a_mesh_turn_with_it(tmp_path: Any) -> None:
    """Those of a file, which do not follow from its vertices. Mitsuba would make normals of its own."""
    path = tmp_path / "tilted.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0.6 0 0.8\nf 1//1 2//1 3//1\n")
    scene = scene_of(box={"type": "obj", "filename": str(path), "id": "box"})
    data = Renderer.from_scene(scene, **OPTIONS).data
    turn = T().rotate([1, 0, 0], 90)
    with updated(data, Changes(transforms={"box": matrix_of(turn)})):
        normals = mi.traverse(scene)["box.vertex_normals"].numpy().reshape(-1, 3)
    np.testing.assert_allclose(normals, [[0.6, -0.8, 0]] * 3, atol=1e-6)
    np.testing.assert_allclose(mi.traverse(scene)["box.vertex_normals"].numpy().reshape(-1, 3), [[0.6, 0, 0.8]] * 3, atol=1e-6)


def test_a_change_that_mitsuba_does_not_allow_leaves_the_scene_as_it_was() -> None:
    scene = scene_of()
    data = Renderer.from_scene(scene, **OPTIONS).data
    old = values_of(scene)
    changes = Changes(values={"box.bsdf.reflectance.value": np.array([0.1, 0.6, 0.2]), "box.bsdf.gloss": np.array([1.0])})
    with pytest.raises(ShadowmapError, match=r"box\.bsdf\.gloss"), updated(data, changes):
        pass
    for key, value in values_of(scene).items():
        np.testing.assert_array_equal(old[key], value, err_msg=key)


def test_parts_of_an_instance_do_not_move_by_themselves() -> None:
    group = {"type": "shapegroup", "one": box(0), "other": box(0.9)}
    scene = scene_of(box=None, group=group, copy={"type": "instance", "shapegroup": REFERENCE})
    data = Renderer.from_scene(scene, **OPTIONS).data
    matrix = matrix_of(T().translate([0, 0, 1]))
    with pytest.raises(ShadowmapError, match="all parts of its instance"):
        with updated(data, Changes(transforms={"copy.one": matrix})):
            pass
    with updated(data, Changes(transforms={"copy.one": matrix, "copy.other": matrix})):
        pass


# ------------------------------------------------------------------------------------------------------------- images

SHIFTED = {"principal_point_offset_x": 0.08, "principal_point_offset_y": -0.05}
WINDOW = {"width": 64, "height": 48, "crop_width": 40, "crop_height": 30, "crop_offset_x": 20, "crop_offset_y": 4}
CAMERAS: dict[str, Any] = {
    "plain": lambda: camera(64, 48),
    "shifted": lambda: camera(64, 48, **SHIFTED),
    "window": lambda: camera(film=WINDOW, **SHIFTED),
    "luminance": lambda: camera(64, 48, film={"pixel_format": "luminance"}),
    "orthographic": lambda: {"type": "orthographic", "to_world": flat(), "film": camera(64, 48)["film"]},
}


def flat() -> Any:
    return T().look_at([2, -3, 4], [0, 0, 0], [0, 0, 1]) @ T().scale(2)


@pytest.mark.parametrize("name", CAMERAS)
def test_images_are_those_of_the_sensor(name: str) -> None:
    """At the sensor's own size, and reduced."""
    renderer = renderer_of(camera=CAMERAS[name]())
    expected = np.array(mi.render(renderer.data.scene, integrator=mi.load_dict({"type": "direct"}), spp=1024))[..., :3]
    height, width = expected.shape[:2]
    view = view_of(renderer, ImageSize(width, height))
    found = image_of(renderer, view.camera(np.zeros(0)), (width, height), ImageSize(width, height))
    # Noise: pixels that the edge of the box crosses.
    assert np.abs(found - expected).mean() < 0.004
    small = ImageSize(width // 2, height // 2)
    reduced = image_of(renderer, view_of(renderer, small).camera(np.zeros(0)), (width, height), small)
    blocks = expected.reshape(height // 2, 2, width // 2, 2, -1).mean((1, 3))
    assert np.abs(reduced - blocks).mean() < 0.003


def view_of(renderer: Renderer, size: ImageSize) -> View:
    few, many = Resolver(renderer).parameters([Vary.parse(entry) for entry in ()])
    return View(renderer, few, many, 0, size, Quality(size.width, 4, 64, 4, 32))


def image_of(renderer: Renderer, camera: Sensor, window: tuple[int, int], size: ImageSize) -> Image:
    (found,) = Reference(renderer.data, [window]).images(Changes(), [camera], [size])
    return found


def test_light_bounces_if_the_scene_says_so() -> None:
    images = {}
    for name in ("direct", "path"):
        renderer = renderer_of(integrator={"type": name})
        size = ImageSize(32, 24)
        images[name] = image_of(renderer, view_of(renderer, size).camera(np.zeros(0)), (32, 24), size)
    assert images["path"].mean() > 1.01 * images["direct"].mean()


def test_an_integrator_that_shows_something_else_is_replaced() -> None:
    size = ImageSize(32, 24)
    images = {}
    for name in ("direct", "depth"):
        renderer = renderer_of(integrator={"type": name})
        images[name] = image_of(renderer, view_of(renderer, size).camera(np.zeros(0)), (32, 24), size)
    np.testing.assert_allclose(images["depth"], images["direct"], atol=1e-5)

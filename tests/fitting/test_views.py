"""Images of views and their derivatives by the numbers of a fit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from fitting_scenes import OPTIONS, box, camera, diffuse, floor, rgb, scene_of, sun

from mitsuba_baselines import derivatives
from shadowmap_dr import Renderer
from shadowmap_dr.fitting.mitsuba_values import set_values
from shadowmap_dr.fitting.parameters import Parameter
from shadowmap_dr.fitting.resolve import Resolver
from shadowmap_dr.fitting.scene_change import SceneChange
from shadowmap_dr.fitting.vary import Vary
from shadowmap_dr.fitting.views import Quality, View
from shadowmap_dr.scene.sensor import ImageSize

SIZE = ImageSize(60, 45)
QUALITY = Quality(60, 16, 64, 4, 32)
# A window of the film that is off its middle, of a camera whose axis is off it, too.
WINDOW = {"width": 64, "height": 48, "crop_width": 40, "crop_height": 30, "crop_offset_x": 20, "crop_offset_y": 4}
SHIFTED = {"principal_point_offset_x": 0.08, "principal_point_offset_y": -0.05}


def soft_lights() -> dict[str, Any]:
    T = mi.ScalarTransform4f
    place = T().translate([0.5, 0.4, 3]) @ T().rotate([1, 0, 0], 180) @ T().scale(0.4)
    panel = {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": rgb(6, 5, 4)}}
    return {"sun": None, "panel": panel, "sky": {"type": "constant", "radiance": rgb(0.3, 0.4, 0.5)}}


def spot() -> dict[str, Any]:
    to_world = mi.ScalarTransform4f().look_at([1, 1, 4], [0, 0, 0.3], [0, 1, 0])
    return {"type": "spot", "to_world": to_world, "cutoff_angle": 25, "beam_width": 18, "intensity": rgb(20, 18, 15)}


SCENES: dict[str, Any] = {
    "sun": lambda: scene_of(),
    "spot": lambda: scene_of(sun=None, spot=spot()),
    "point": lambda: scene_of(sun=None, lamp={"type": "point", "position": [0.8, 0.5, 2.8], "intensity": rgb(12, 10, 8)}),
    "window": lambda: scene_of(camera=camera(film=WINDOW, **SHIFTED)),
    "soft": lambda: scene_of(**soft_lights()),
}


@pytest.fixture(scope="module")
def renderers() -> Iterator[dict[str, Renderer]]:
    """Renderers of the scenes by name, made once."""
    mi.set_variant("llvm_ad_rgb")
    made = {name: Renderer.from_scene(build(), **OPTIONS) for name, build in SCENES.items()}
    yield made
    made.clear()


def view_of(renderer: Renderer, *entries: str, size: ImageSize = SIZE, quality: Quality = QUALITY) -> View:
    few, many = Resolver(renderer).parameters([Vary.parse(entry) for entry in entries])
    return View(renderer, few, many, 0, size, quality)


def agreement(view: View, number: int, step: float, at: np.ndarray) -> derivatives.Agreement:
    """Agreement of a derivative image with central differences."""
    _, automatic = view.derivative(at, number)
    change = np.zeros(view.count)
    change[number] = step
    after, before = (view.image(at + sign * change).copy() for sign in (1, -1))
    return derivatives.agreement(automatic, (after - before) / (2 * step))


# Scenes, entries, steps of the differences, and least agreement. Steps are in the fit's own numbers.
MOVING = [
    ("sun", "box:pose", 0.01),
    ("sun", "box:rotation:y", 0.02),
    ("sun", "box:translation:xz", 0.01),
    ("sun", "box:scale", 0.02),
    ("sun", "sun:direction", 0.01),
    ("spot", "spot:pose", 0.005),
    ("spot", "spot:direction", 0.005),
    ("point", "lamp:position", 0.01),
    ("window", "camera:pose", 0.003),
    ("window", "camera:fov", 0.01),
    ("soft", "panel:translation:xy", 0.01),
]


@pytest.mark.parametrize(("scene", "entry", "step"), MOVING)
def test_derivatives_of_motions_are_those_of_differences(
    renderers: dict[str, Renderer], scene: str, entry: str, step: float
) -> None:
    """Away from the scene as it was given, for all numbers of an entry."""
    view = view_of(renderers[scene], entry)
    at = 0.02 * np.cos(np.arange(view.count))
    # The cone of a spot light that rolls stays where it is.
    numbers = [number for number in range(view.count) if (entry, number) != ("spot:pose", 2)]
    found = [agreement(view, number, step, at) for number in numbers]
    assert all(each.cosine > 0.98 and abs(each.scale - 1) < 0.08 for each in found), found
    if len(numbers) < view.count:
        idle, others = (np.abs(view.derivative(at, number)[1]).mean() for number in (2, 0))
        assert idle < 0.05 * others


@pytest.mark.parametrize(("scene", "entry"), [("sun", "box:pose"), ("sun", "sun:direction"), ("soft", "panel:translation:xy")])
def test_a_jacobian_has_the_derivatives_of_all_numbers_of_an_entry(
    renderers: dict[str, Renderer], scene: str, entry: str
) -> None:
    view = view_of(renderers[scene], "floor:value", entry)
    at, numbers = 0.02 * np.cos(np.arange(view.count)), range(3, view.count)
    for x in (at, 0.5 * at):  # recorded, and replayed
        image, columns = view.jacobian(x, 1)
        assert len(columns) == len(numbers)
        for number, column in zip(numbers, columns, strict=True):
            same, derivative = view.derivative(x, number)
            np.testing.assert_allclose(image, same, atol=1e-3)
            assert np.linalg.norm(column - derivative) < 0.02 * np.linalg.norm(derivative)


@pytest.mark.parametrize("what", ["image", "derivative", "jacobian"])
def test_passes_are_recorded_once_wherever_numpy_has_its_numbers(renderers: dict[str, Renderer], what: str) -> None:
    """Their addresses are of all alignments."""
    view = view_of(renderers["sun"], "box:pose", size=ImageSize(8, 6), quality=Quality(8, 1, 16, 4, 32))
    calls = {"image": view.image, "derivative": lambda x: view.derivative(x, 1), "jacobian": view.jacobian}
    recorded = {"image": view._image, "derivative": view._passes[0], "jacobian": view._jacobians[0]}[what]
    calls[what](np.zeros(view.count))
    calls[what](np.zeros(view.count))
    before, kept = recorded.n_recordings, []
    for k in range(24):
        kept.append(np.zeros(1 + k % 7, np.float32))
        calls[what](np.full(view.count, 0.001 * k))
    assert recorded.n_recordings == before


def test_a_jacobian_of_values_that_are_not_recorded_has_differences(renderers: dict[str, Renderer]) -> None:
    view, x = view_of(renderers["sun"], "floor:value"), np.zeros(3)
    recorded = [column.copy() for column in view.jacobian(x)[1]]
    view._differences = [True]
    image, columns = view.jacobian(x)
    np.testing.assert_allclose(image, view.image(x), atol=1e-5)
    for column, other in zip(columns, recorded, strict=True):
        np.testing.assert_allclose(column, other, atol=0.02 * np.abs(other).max())


# Images are smooth functions of these: pixels agree.
COLOURS = [
    ("sun", "box.bsdf.reflectance"),
    ("sun", "floor:value"),
    ("sun", "sun.irradiance"),
    ("sun", "sun:brightness"),
    ("spot", "spot.intensity"),
    ("soft", "panel.emitter.radiance"),
    ("soft", "sky.radiance"),
    ("soft", "sky:sky"),
]


@pytest.mark.parametrize(("scene", "entry"), COLOURS)
def test_derivatives_by_colours_are_those_of_differences(renderers: dict[str, Renderer], scene: str, entry: str) -> None:
    view = view_of(renderers[scene], entry)
    at = 0.1 * np.cos(np.arange(view.count))
    step = 0.02
    for number in range(view.count):
        _, automatic = view.derivative(at, number)
        after, before = (view.image(at + sign * step * np.eye(view.count)[number]).copy() for sign in (1, -1))
        difference = (after - before) / (2 * step)
        assert np.abs(difference).max() > 0.02
        np.testing.assert_allclose(automatic, difference, atol=3e-3 * np.abs(difference).max())
        if view.count == 3:  # each number moves its own colour
            assert (np.abs(automatic).max((0, 1)) > 1e-6).tolist() == (np.arange(3) == number).tolist()


def test_numbers_of_several_entries_are_told_apart(renderers: dict[str, Renderer]) -> None:
    """A column is that of its entry, at the values of all others; entries of the same object, too."""
    entries = ("box:translation:x", "sun:direction", "box:rotation:z", "box.bsdf.reflectance")
    view, x = view_of(renderers["sun"], *entries), np.array([0.1, 0.2, -0.1, 0.3, 0.1, -0.2, 0.05])
    assert view.count == 7
    images = [view.derivative(x, number)[0].copy() for number in range(7)]
    for image in images:
        np.testing.assert_allclose(image, view.image(x), atol=1e-5)
    for number, step in enumerate((0.01, 0.01, 0.01, 0.02, 0.02, 0.02, 0.02)):
        found = agreement(view, number, step, x)
        assert found.cosine > 0.97 and abs(found.scale - 1) < 0.05, (number, found)


# ------------------------------------------------------------------------------------------------------------------- images


def averaged(image: Any, size: ImageSize) -> np.ndarray:
    pixels = np.array(image)[..., :3]
    pixels = np.repeat(pixels, 3 // pixels.shape[2], axis=2)
    rows, columns = pixels.shape[0] // size.height, pixels.shape[1] // size.width
    return pixels.reshape(size.height, rows, size.width, columns, 3).mean((1, 3))


@pytest.mark.parametrize("film", [{}, {"pixel_format": "luminance"}, {"pixel_format": "rgba"}, {"rfilter": {"type": "gaussian"}}])
def test_image_is_the_average_of_that_of_the_sensor(film: dict[str, Any]) -> None:
    """Also of a window of the film, whose size the view's does not follow."""
    mi.set_variant("llvm_ad_rgb")
    scene = scene_of(camera=camera(film={**WINDOW, **film}, **SHIFTED))
    renderer = Renderer.from_scene(scene, **OPTIONS)
    box_film = camera(film={**WINDOW, **film, "rfilter": {"type": "box"}}, **SHIFTED)
    own = Renderer.from_scene(scene_of(camera=box_film), **OPTIONS).render(spp=16)
    for size in (ImageSize(20, 15), ImageSize(20, 10)):  # pixels that are no squares, too: sides of pictures are rounded
        found = view_of(renderer, "sun:direction", size=size).image(np.zeros(2))
        assert found.shape == (size.height, 20, 3)
        difference = np.abs(found - averaged(own, size))
        assert difference.max() < 0.03 and difference.mean() < 1e-3, (difference.max(), difference.mean())


def test_image_is_that_of_mitsuba(renderers: dict[str, Renderer]) -> None:
    scene = renderers["window"].data.scene
    expected = averaged(mi.render(scene, integrator=mi.load_dict({"type": "direct"}), spp=64), ImageSize(20, 15))
    found = view_of(renderers["window"], "sun:direction", size=ImageSize(20, 15)).image(np.zeros(2))
    # Filters of the maps widen the edges of shadows.
    assert np.median(np.abs(found - expected)) < 1e-3 and np.abs(found - expected).mean() < 0.04 * expected.mean()


def test_image_of_no_numbers(renderers: dict[str, Renderer]) -> None:
    """As for a fit of the exposure alone."""
    with_numbers = view_of(renderers["sun"], "sun:direction").image(np.zeros(2))
    np.testing.assert_allclose(view_of(renderers["sun"]).image(np.zeros(0)), with_numbers, atol=1e-6)


def test_image_of_numbers_is_that_of_a_scene_with_their_values(renderers: dict[str, Renderer]) -> None:
    """Loaded by Mitsuba with another colour, light and angle of view."""
    view = view_of(renderers["sun"], "box.bsdf.reflectance", "sun.irradiance", "camera:fov")
    x = np.array([0.2, -0.1, 0.1, 0.3, 0, -0.5, 0.2])
    parameters = Resolver(renderers["sun"]).parameters([Vary.parse(t) for t in ("box.bsdf.reflectance", "sun.irradiance")])[0]
    colour, light = parameters[0].scale.shown(x[:3]), parameters[1].scale.shown(x[3:6])
    scene = scene_of(
        box={**box(0), "bsdf": diffuse(*colour)}, sun=sun(irradiance=rgb(*light)), camera=camera(fov=45 * float(np.exp(0.2)))
    )
    expected = view_of(Renderer.from_scene(scene, **OPTIONS)).image(np.zeros(0))
    np.testing.assert_allclose(view.image(x), expected, atol=0.012)
    assert np.abs(view.image(x) - expected).mean() < 1e-3


# ------------------------------------------------------------------------------------------------------ the scene's own values


def numbers_of(scene: mi.Scene) -> dict[str, np.ndarray]:
    table = mi.traverse(scene)
    found = {}
    for key, value in table:
        if dr.is_array_v(value) or isinstance(value, (int, float)):
            found[key] = np.array(dr.detach(value)).copy()
        elif hasattr(value, "matrix"):
            found[key] = np.array(dr.detach(value.matrix)).copy()
    return found


def test_passes_leave_the_scene_as_it_was() -> None:
    mi.set_variant("llvm_ad_rgb")
    picture = np.random.default_rng(1).uniform(0.2, 0.8, (4, 4, 3)).astype(np.float32)
    texture = {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": mi.Bitmap(picture), "raw": True}}
    scene = scene_of(floor={**floor(), "bsdf": texture}, sky={"type": "constant", "radiance": rgb(0.3, 0.4, 0.5)})
    renderer = Renderer.from_scene(scene, **OPTIONS)
    # Outlines are sums without a fixed order, which differ by rounding: without them, images are equal bit by bit.
    settings = renderer.settings
    unblended = replace(settings, antialias=False, shadow=replace(settings.shadow, antialias=False))
    plain = replace(renderer, settings=unblended)
    before, images = numbers_of(scene), [one.render().numpy() for one in (renderer, plain)]
    entries = ("box:pose", "box.bsdf.reflectance", "sun.irradiance", "sky.radiance", "camera:pose", "floor:texture")
    view = view_of(renderer, *entries, size=ImageSize(16, 12), quality=Quality(16, 1, 32, 2, 16))
    x = np.full(view.count, 0.1)
    view.values[0] = view.values[0] * 0.5
    view.image(x)
    view.derivative(x, 7)
    shape = (12, 16, 3)
    view.gradient(x, np.zeros(shape, np.float32), np.ones((12, 16, 1), np.float32), np.ones(shape, np.float32), 1.0)
    after = numbers_of(scene)
    assert before.keys() == after.keys() and len(before) > 10
    for key, value in before.items():
        np.testing.assert_array_equal(after[key], value, err_msg=key)
    np.testing.assert_array_equal(plain.render().numpy(), images[1])
    np.testing.assert_allclose(renderer.render().numpy(), images[0], rtol=1e-6)
    assert not any(dr.grad_enabled(value) for _, value in mi.traverse(scene) if dr.is_array_v(value) and dr.is_diff_v(value))


def test_values_are_set_and_given_back() -> None:
    mi.set_variant("llvm_ad_rgb")
    renderer = Renderer.from_scene(scene_of(), **OPTIONS)
    scene = renderer.data.scene
    change = SceneChange(renderer)
    change.values["box.bsdf.reflectance.value"] = [mi.Float(0.1), mi.Float(0.2), mi.Float(0.3)]
    before = numbers_of(scene)
    restore = set_values(scene, change)
    np.testing.assert_allclose(numbers_of(scene)["box.bsdf.reflectance.value"].ravel(), [0.1, 0.2, 0.3], atol=1e-6)
    restore()
    np.testing.assert_array_equal(numbers_of(scene)["box.bsdf.reflectance.value"], before["box.bsdf.reflectance.value"])


def test_objects_that_are_slow_to_change_are_changed_when_their_values_are(monkeypatch: pytest.MonkeyPatch) -> None:
    mi.set_variant("llvm_ad_rgb")
    description = scene_of()
    renderer = Renderer.from_scene(description, **OPTIONS)
    view = view_of(renderer, "box.bsdf.reflectance", "sun:direction")
    x, sets = np.zeros(view.count), list[str]()
    given = mi.SceneParameters.__setitem__

    def counted(self: mi.SceneParameters, key: str, value: object) -> None:
        sets.append(key)
        given(self, key, value)

    monkeypatch.setattr(mi.SceneParameters, "__setitem__", counted)
    view.image(x)
    assert not sets  # the values are those of the scene
    x[0] = 0.3
    view.image(x)
    assert sets == ["box.bsdf.reflectance.value"] * 2  # set, and given back


def test_changes_are_detached(renderers: dict[str, Renderer]) -> None:
    view = view_of(renderers["sun"], "box:translation:x", "sun.irradiance")
    change = view.change(np.array([0.2, 0.1, 0.1, 0.1]))
    parameter: Parameter = Resolver(renderers["sun"]).parameters([Vary.parse("box:translation:x")])[0][0]
    assert change.placements.keys() == {"box"} and change.lights.keys() == {"sun"}
    assert not dr.grad_enabled(change.placements["box"])
    assert change.placements["box"][0, 3][0] == pytest.approx(float(parameter.scale.shown([0.2])[0]), rel=1e-5)

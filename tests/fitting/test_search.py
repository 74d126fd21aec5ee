"""Whole fits to pictures that Mitsuba rendered, with its own integrator ``direct``, of scenes that are changed in known ways."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import numpy.typing as npt
import pytest
from fitting_scenes import box, camera, diffuse, floor, renderer_of, scene_of, sun

from shadowmap_dr import Renderer
from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.fitting import Estimate, Fit, FitOptions, FitResult, Own, SceneChange, Vary, fit, make_target, prepared
from shadowmap_dr.io import assets

Image = npt.NDArray[np.float32]
SIZE = {"width": 48, "height": 36}


@pytest.fixture(autouse=True)
def one_backend() -> None:
    """Fits take seconds; that both backends agree is tested for images and derivatives."""
    mi.set_variant("llvm_ad_rgb")


def photograph(scene: mi.Scene, sensor: int = 0, spp: int = 64) -> Image:
    image = mi.render(scene, sensor=sensor, integrator=mi.load_dict({"type": "direct"}), spp=spp)
    return np.array(image)[..., :3]


def scene(**parts: Any) -> mi.Scene:
    return scene_of(**{"camera": camera(film=SIZE), **parts})


def renderer(**parts: Any) -> Renderer:
    return renderer_of(**{"camera": camera(film=SIZE), **parts})


@pytest.fixture(scope="module")
def picture() -> Image:
    """The box on the floor under the sun, as the scene has them."""
    mi.set_variant("llvm_ad_rgb")
    return photograph(scene())


def estimate(result: FitResult, name: str) -> Estimate:
    return next(each for each in result.estimates if each.name == name)


def turn(degrees: float, axis: list[float]) -> Any:
    return mi.ScalarTransform4f().rotate((np.array(axis) / np.linalg.norm(axis)).tolist(), degrees)


def angle(a: Any, b: Any) -> float:
    """Angle in degrees of two rotations (3, 3) or directions (3,)."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    if a.ndim == 2:
        cosine = (np.trace(a.T @ b) - 1) / 2
    else:
        cosine = a.ravel() @ b.ravel() / np.linalg.norm(a) / np.linalg.norm(b)
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


# ----------------------------------------------------------------------------------------------------------- what is found


def test_a_pose_is_found() -> None:
    """Of a cow, whose shadow falls onto a wall."""
    path = str(assets.scene("pose"))
    T = mi.ScalarTransform4f
    true = T().translate([0.1, 0.05, -0.1]) @ turn(15, [0.6, -0.7, 0.4])
    moved = mi.load_file(path, optimize=False, resolution="64")
    table = mi.traverse(moved)
    points = table["object.vertex_positions"].numpy().reshape(-1, 3)
    matrix = np.array(true.matrix)
    table["object.vertex_positions"] = mi.Float((points @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32).ravel())
    table.update()
    result = fit(mi.load_file(path, optimize=False, resolution="64"), photograph(moved), "object:pose", starts=1)
    found = estimate(result, "object:pose").arrays["matrix"]
    assert result.found and not result.words
    assert angle(found[:3, :3], matrix[:3, :3]) < 0.5
    middle = 0.5 * (points.min(0) + points.max(0))
    np.testing.assert_allclose(found[:3, :3] @ middle + found[:3, 3], matrix[:3, :3] @ middle + matrix[:3, 3], atol=0.015)
    widths = estimate(result, "object:pose").half_width
    assert widths is not None and (widths[:3] < 2).all() and (widths[3:] < 0.05).all()


def test_the_direction_of_the_sun_is_found() -> None:
    """From 30 degrees beside it, with few starts."""
    direction = [-0.2, 0.45, -1.0]
    seen = photograph(scene(sun=sun(direction=direction)))
    result = fit(renderer(), seen, ["sun:direction,spread=40"], starts=4)
    assert angle([0.4, 0.3, -1], direction) > 25
    assert result.found and angle(estimate(result, "sun:direction").arrays["direction"], direction) < 0.5
    # Turns are angles: together they are the turn that was found.
    assert np.hypot(*estimate(result, "sun:direction").values) == pytest.approx(angle([0.4, 0.3, -1], direction), abs=1)
    # The picture has fewer pixels than the default resolution: it has its own.
    assert result.pictures[0].fit.shape == (36, 48, 3) and result.history[-1]["stage"] == "48 px"
    assert {step["start"] for step in result.history} == {0, 1, 2, 3}


def test_colours_are_found() -> None:
    """Of a box, and of the sun, as the floor's is known."""
    colour, light = [0.2, 0.6, 0.4], [1.5, 1.5, 2.5]
    seen = photograph(scene(box={**box(0), "bsdf": diffuse(*colour)}, sun=sun(irradiance={"type": "rgb", "value": light})))
    result = fit(renderer(), seen, ["box.bsdf.reflectance,max=0.9", "sun.irradiance"], starts=1)
    np.testing.assert_allclose(estimate(result, "box.bsdf.reflectance").values, colour, rtol=0.03)
    np.testing.assert_allclose(estimate(result, "sun.irradiance").values, light, rtol=0.01)
    np.testing.assert_allclose(estimate(result, "sun.irradiance").arrays["value"], light, rtol=0.01)
    np.testing.assert_allclose(estimate(result, "sun.irradiance").start, [2, 1.5, 1], rtol=1e-5)


def vignette(image: Image, amount: float) -> Image:
    y, x = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
    height, width = image.shape[:2]
    square = (x - width / 2) ** 2 + (y - height / 2) ** 2
    return image * (1 + amount * square / (height**2 + width**2) * 4)[..., None].astype(np.float32)


def test_white_balance_and_vignetting_of_a_picture_are_found(picture: Image) -> None:
    stops = np.array([-1.0, -0.5, 0.25])
    taken = vignette(picture * (2.0**stops).astype(np.float32), -0.35)
    result = fit(renderer(), taken, [], starts=1, white_balance=True, vignetting=True)
    np.testing.assert_allclose(estimate(result, "white balance of the target").values, stops, atol=0.02)
    np.testing.assert_allclose(estimate(result, "vignetting of the target").values, -0.35, atol=0.02)
    assert result.found and result.names == [f"white balance of the target, {one}" for one in ("red", "green", "blue")] + [
        "vignetting of the target"
    ]
    assert result.pictures[0].exposure == pytest.approx(np.mean(2.0**stops), rel=0.02)


def test_exposure_alone_is_found(picture: Image) -> None:
    """Nothing in the scene varies."""
    result = fit(renderer(), picture * np.float32(0.125), [], starts=1, exposure=True)
    assert result.found
    np.testing.assert_allclose(estimate(result, "exposure of the target").values, -3, atol=0.02)


def test_known_exposures_are_applied(picture: Image) -> None:
    target = make_target(picture * np.float32(0.25), exposure=0.25)
    options = FitOptions(vary=(Vary("sun", "brightness"),), starts=1)
    known = fit(renderer(), target, "sun:brightness", starts=1)
    np.testing.assert_allclose(estimate(known, "sun:brightness").values, 1, rtol=0.01)
    unknown = Fit(renderer(), [replace(target, exposure=1.0)], options).run()
    np.testing.assert_allclose(estimate(unknown, "sun:brightness").values, 0.25, rtol=0.01)


def test_brightness_and_exposure_cannot_be_told_apart(picture: Image) -> None:
    """There is no other light."""
    result = fit(renderer(), picture, ["sun:brightness"], starts=1, exposure=True)
    assert "sun:brightness and exposure of the target cannot be told apart by the pictures." in result.words
    widths = [each.half_width for each in result.estimates]
    assert all(width is not None and np.isinf(width).all() for width in widths)
    # A prior tells them apart.
    result = fit(renderer(), picture, ["sun:brightness,prior=0.1"], starts=1, exposure=True)
    assert result.found and not any("told apart" in words for words in result.words)


def test_the_height_of_a_small_thing_is_found() -> None:
    """A box of some 20 of 27,648 pixels, in a picture of a wide floor: less than 0.005 of its brightness."""
    T = mi.ScalarTransform4f
    tall = 1.2

    def wide(height: float) -> mi.Scene:
        place = T().translate([0.3, 0.4, 0]) @ T().scale([0.04, 0.04, height]) @ T().translate([0, 0, 1])
        house = {"type": "cube", "to_world": place, "bsdf": diffuse(0.7, 0.7, 0.7)}
        return scene_of(box=None, house=house, camera=camera(192, 144))

    def put(numbers: list[mi.Float], change: SceneChange) -> None:
        change.move(["house"], mi.Matrix4f(1, 0, 0, 0, 0, 1, 0, 0, 0, 0, numbers[0], 0, 0, 0, 0, 1))

    height = Own("height", put, start=[1.0], spread=0.3, low=0.2)
    result = fit(wide(0.03), photograph(wide(0.03 * tall)), [height], starts=2)
    found = estimate(result, "height")
    assert result.found and not result.words and found.half_width is not None
    # The height is four pixels.
    np.testing.assert_allclose(found.values, tall, rtol=0.04)
    assert abs(float(found.values[0]) - tall) < float(found.half_width[0]) < 0.2


def test_small_things_do_not_stay_in_minima_of_their_own() -> None:
    """Heights of three houses, one behind the others: a descent makes the hindmost too low to be seen."""
    T = mi.ScalarTransform4f
    places, sides = [(-0.3, 0.21), (-0.1, 0.12), (-0.15, 0.02)], (0.042, 0.064, 0.069)
    true = (1.361, 0.756, 1.198)

    def village(heights: tuple[float, ...]) -> mi.Scene:
        houses = {}
        for k, ((x, y), side, height) in enumerate(zip(places, sides, heights, strict=True)):
            place = T().translate([x, y, 0]) @ T().scale([side, side, 2 * side * height]) @ T().translate([0, 0, 1])
            houses[f"house_{k}"] = {"type": "cube", "to_world": place, "bsdf": diffuse(0.7, 0.7, 0.7)}
        return scene_of(box=None, camera=camera(128, 96), **houses)

    def height(k: int) -> Own:
        def put(numbers: list[mi.Float], change: SceneChange) -> None:
            change.move([f"house_{k}"], mi.Matrix4f(1, 0, 0, 0, 0, 1, 0, 0, 0, 0, numbers[0], 0, 0, 0, 0, 1))

        return Own(f"house_{k}", put, start=[1.0], spread=0.5, low=0.2)

    result = fit(village((1.0, 1.0, 1.0)), photograph(village(true)), [height(k) for k in range(3)], starts=1)
    assert result.found and not result.words
    np.testing.assert_allclose([each.values[0] for each in result.estimates], true, rtol=0.02)


def test_what_moves_nothing_is_named(picture: Image) -> None:
    """A box behind the camera."""
    result = fit(renderer(far=box(5, -9)), picture, ["sun:brightness", "far.bsdf.reflectance"], starts=1)
    assert result.words == [f"far.bsdf.reflectance {one} moves nothing in the pictures." for one in ("red", "green", "blue")]
    np.testing.assert_allclose(estimate(result, "sun:brightness").values, 1, rtol=0.01)


def test_masked_pixels_do_not_matter(picture: Image) -> None:
    """Objects that the scene does not have are painted over."""
    spoiled, mask = picture.copy(), np.ones(picture.shape[:2], np.float32)
    spoiled[20:, :16], mask[20:, :16] = 5, 0
    result = fit(renderer(), make_target(spoiled, mask), ["sun:direction"], starts=1)
    assert result.found and np.abs(estimate(result, "sun:direction").values).max() < 1.2


# -------------------------------------------------------------------------------------------------------------------- views


def second() -> dict[str, Any]:
    """A camera from the other side, of another shape."""
    to_world = mi.ScalarTransform4f().look_at([-3, 2, 3], [0, 0, 0], [0, 0, 1])
    return camera(film={"width": 32, "height": 32}, to_world=to_world)


def test_two_views_are_fitted_together() -> None:
    shift = mi.ScalarTransform4f().translate([0.15, -0.1, 0.1])
    moved = scene(box={**box(0), "to_world": shift @ box(0)["to_world"]}, second=second())
    views = [photograph(moved, sensor) for sensor in (0, 1)]
    # The first picture is twice as bright.
    given = {0: views[0] * np.float32(2), 1: views[1]}
    result = fit(renderer(second=second()), given, ["box:translation"], starts=1, exposure=True)
    assert result.found and len(result.pictures) == 2
    np.testing.assert_allclose(estimate(result, "box:translation").values, [0.15, -0.1, 0.1], atol=0.01)
    exposures = [each.values[0] for each in result.estimates if each.kind == "exposure"]
    np.testing.assert_allclose(exposures, [1, 0], atol=0.03)
    listed = prepared(renderer(second=second()), views, ["box:translation"])
    assert [target.sensor for target in listed.targets] == [0, 1]


def test_cameras_are_found() -> None:
    """Place and direction, and an angle of view."""
    place = camera()["to_world"] @ mi.ScalarTransform4f().translate([0.1, 0, 0.2]) @ turn(3, [1, 2, 0])
    result = fit(renderer(), photograph(scene(camera=camera(film=SIZE, to_world=place))), ["camera:pose"], starts=1)
    found = estimate(result, "camera:pose").arrays["to_world"]
    assert result.found and angle(found[:3, :3], np.array(place.matrix)[:3, :3]) < 1  # of 45 degrees in 48 pixels
    np.testing.assert_allclose(found[:3, 3], np.array(place.matrix)[:3, 3], atol=0.08)
    result = fit(renderer(), photograph(scene(camera=camera(film=SIZE, fov=50))), ["camera:fov"], starts=1)
    np.testing.assert_allclose(estimate(result, "camera:fov").values, 50, atol=0.25)


# ------------------------------------------------------------------------------------------------------------- what is not


def test_a_picture_of_another_scene_is_not_found(picture: Image) -> None:
    other = photograph(scene(box=None, pole={"type": "cylinder", "p0": [-1, 1, 0], "p1": [-1, 0, 2], "radius": 0.4}))
    upside_down = 1.5 * other[::-1] + 0.2
    result = fit(renderer(), upside_down, ["box:translation:x"], starts=2)
    assert not result.found and "of the edges that matter in the picture are not where" in result.words[0]
    assert result.pictures[0].error > 0.12


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: fit(renderer(), [], ["sun:direction"]), "there is no picture to fit to"),
        (lambda: fit(renderer(), np.ones((36, 48, 3)), []), "nothing varies: name something by --vary"),
        (lambda: fit(renderer(), np.ones((48, 48, 3)), ["sun"]), "has 48 x 48 pixels, sensor 0 has 48 x 36, of another shape"),
        (lambda: fit(renderer(), {1: np.ones((36, 48, 3))}, ["sun"]), "is of sensor 1, but the scene has 1, counted from 0"),
        (lambda: fit(renderer(), np.ones((36, 48, 3)), ["moon"]), "no object or value 'moon'"),
        (lambda: fit(renderer(), np.ones((36, 48, 3)), ["sun", "sun"]), "vary sun is given twice"),
        (lambda: fit(renderer(), np.ones((36, 48, 3)), ["sun"], startz=3), "the options are exposure, white_balance"),
        (lambda: fit(renderer(), np.ones((36, 48, 3)), ["sun"], starts=0), "starts"),
        (
            lambda: fit(renderer(), np.ones((36, 48, 3)), ["box.bsdf.reflectance,min=2"]),
            "the bounds leave nothing between 2 and 1",
        ),
        (lambda: fit(renderer(), np.ones((36, 48, 3)), ["sun"], exposure=True, white_balance=True), "leave exposure out"),
        (lambda: prepared(renderer(), np.ones((36, 48, 3)), ["sun"]).result(), "the fit has taken no steps yet"),
    ],
)
def test_what_cannot_be_fitted(make: Callable[[], Any], words: str) -> None:
    with pytest.raises(ShadowmapError) as raised:
        make()
    assert words in str(raised.value) and "\n" not in str(raised.value)


def test_bounds_are_kept() -> None:
    """Of a colour that is brighter than allowed."""
    seen = photograph(scene(box={**box(0), "bsdf": diffuse(0.9, 0.9, 0.9)}))
    result = fit(renderer(), seen, ["box.bsdf.reflectance,max=0.8"], starts=2)
    np.testing.assert_allclose(estimate(result, "box.bsdf.reflectance").values, 0.8, atol=1e-4)


# -------------------------------------------------------------------------------------------------------------------- stops


def resumable(picture: Image, **changes: Any) -> Fit:
    moved = {**box(0), "to_world": mi.ScalarTransform4f().translate([0.2, -0.1, 0]) @ box(0)["to_world"]}
    options = {"starts": 3, "spp": 1, "resolution": 32, **changes}
    return prepared(renderer(box=moved), picture, ["box:translation:xy", "sun:direction"], **options)


@pytest.fixture(scope="module")
def straight(picture: Image) -> FitResult:
    """The result without a stop."""
    mi.set_variant("llvm_ad_rgb")
    return resumable(picture).run()


@pytest.mark.parametrize("stop", [1, 12, 20])
def test_a_fit_that_was_killed_goes_on(picture: Image, straight: FitResult, tmp_path: Path, stop: int) -> None:
    """Wherever it was; its result is that of a fit without a stop."""
    np.testing.assert_allclose(estimate(straight, "box:translation:xy").values, [-0.2, 0.1], atol=0.02)
    first = resumable(picture)
    for count, _ in enumerate(first.steps(tmp_path / "fit.npz"), 1):
        if count == stop:
            break
    assert (tmp_path / "fit.npz").exists() == (stop > 1)
    second = resumable(picture)
    done = len(list(second.steps(tmp_path / "fit.npz", resume=True)))
    assert len(straight.history) - stop <= done <= len(straight.history) - (5 if stop > 1 else 0)
    result = second.result()
    strip = [(step["start"], step["stage"], step["step"]) for step in result.history]
    assert strip == [(step["start"], step["stage"], step["step"]) for step in straight.history]
    for ours, theirs in zip(result.estimates, straight.estimates, strict=True):
        np.testing.assert_allclose(ours.values, theirs.values, atol=2e-3)
    assert [text for text, _ in result.pictures[0].frames] == [text for text, _ in straight.pictures[0].frames]


def test_states_of_other_fits_are_refused(picture: Image, tmp_path: Path) -> None:
    state = tmp_path / "fit.npz"
    for _ in resumable(picture).steps(state):
        if state.exists():
            break
    others = [
        resumable(picture, starts=4),
        resumable(picture, seed=1),
        resumable(picture * np.float32(0.5)),
        resumable(picture, exposure=True),
    ]
    for other in others:
        with pytest.raises(ShadowmapError, match="belongs to a run with other settings: delete it") as raised:
            next(iter(other.steps(state, resume=True)))
        assert "\n" not in str(raised.value)
    # Without --resume it is begun anew.
    assert next(iter(others[0].steps(state)))["start"] == 0


def test_a_prior_without_width_holds_a_number(picture: Image) -> None:
    """Matrices of the steps are not singular."""
    result = fit(renderer(), [make_target(picture)], "sun.irradiance,prior=1e-300", starts=1, tries=1, resolution=12, spp=1)
    np.testing.assert_allclose(result.estimates[0].values, result.estimates[0].start, rtol=1e-4)


@pytest.mark.parametrize("damage", ["empty", "half", "text", "bit"])
def test_damaged_states_are_refused(picture: Image, tmp_path: Path, damage: str) -> None:
    state = tmp_path / "fit.npz"
    for _ in resumable(picture).steps(state):
        if state.exists():
            break
    content = state.read_bytes()
    flipped = bytearray(content)
    flipped[content.index(b"x.npy") + 150] ^= 1
    state.write_bytes({"empty": b"", "half": content[: len(content) // 2], "text": b"numbers", "bit": bytes(flipped)}[damage])
    with pytest.raises(ShadowmapError, match="cannot read") as raised:
        next(iter(resumable(picture).steps(state, resume=True)))
    assert str(state) in str(raised.value) and "\n" not in str(raised.value)


# ------------------------------------------------------------------------------------------------------- textures, vertices


def painted(texels: Any) -> dict[str, Any]:
    """A floor with a texture, and a box that hides a corner."""
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(np.asarray(texels, np.float32)), "raw": True, "filter_type": "nearest"}
    ground = {**floor(), "to_world": mi.ScalarTransform4f().scale(1.6), "bsdf": {"type": "diffuse", "reflectance": bitmap}}
    return {"floor": ground, "box": box(0.9, 0.9)}


TEXELS = np.random.default_rng(4).uniform(0.15, 0.85, (4, 4, 3)).repeat(4, 0).repeat(4, 1)
GREY = np.full((16, 16, 3), 0.5)


@pytest.fixture(scope="module")
def painting() -> Image:
    mi.set_variant("llvm_ad_rgb")
    return photograph(scene(**painted(TEXELS)))


def test_a_texture_is_found(painting: Image) -> None:
    """Of 16 x 16 texels, from grey."""
    result = fit(renderer(**painted(GREY)), painting, ["floor:texture"], starts=1, steps=80)
    texels = estimate(result, "floor:texture").arrays["texture"]
    assert result.found and texels.shape == (16, 16, 3)
    assert ((texels >= 0) & (texels <= 1)).all()
    # Texels that the box hides, or its shadow, are not known: most others are.
    error = np.abs(texels - TEXELS).mean(2)
    assert np.median(error) < 0.03 < 0.15 < np.median(np.abs(0.5 - TEXELS).mean(2))
    assert result.pictures[0].error < 0.06
    # The picture of the start is that of the scene as it was given.
    assert np.abs(result.pictures[0].start - result.pictures[0].target).mean() > 0.02


def repainted(painting: Image) -> Fit:
    entries = ["floor:texture", "sun:brightness,prior=0.01"]
    return prepared(renderer(**painted(GREY)), painting, entries, starts=1, steps=30, resolution=24, spp=1, correct=False)


@pytest.fixture(scope="module")
def unbroken(painting: Image) -> FitResult:
    """The result without a stop."""
    mi.set_variant("llvm_ad_rgb")
    return repainted(painting).run()


@pytest.mark.parametrize("stop", [14, 10**6])
def test_a_fit_of_a_texture_that_was_killed_goes_on(painting: Image, unbroken: FitResult, tmp_path: Path, stop: int) -> None:
    """Together with the sun's brightness; in a stage, and after all of them."""
    first, state = repainted(painting), tmp_path / "fit.npz"
    for count, _ in enumerate(first.steps(state), 1):
        if count == stop:
            break
    second = repainted(painting)
    assert len(list(second.steps(state, resume=True))) < len(unbroken.history)
    result = second.result()
    assert result.pictures[0].error == pytest.approx(unbroken.pictures[0].error, rel=0.02)
    for ours, theirs in zip(result.estimates, unbroken.estimates, strict=True):
        assert np.abs(ours.values - theirs.values).mean() < 2e-3


def test_vertices_are_found() -> None:
    """A bump of a sheet, from its shading and its shadow."""
    pytest.importorskip("cholespy", reason="the package cholespy is not installed: pip install '.[art]'")
    n = 13
    y, x = np.mgrid[:n, :n] / (n - 1) * 2 - 1
    height = 0.3 * np.exp(-4 * (x**2 + y**2))
    index = np.arange(n * n).reshape(n, n)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    faces = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])

    def sheet(z: Any) -> Any:
        mesh = mi.Mesh("sheet", n * n, len(faces), has_vertex_normals=True, props=properties())
        table = mi.traverse(mesh)
        table["vertex_positions"] = np.stack([x, y, 0.6 + z], -1).astype(np.float32).ravel()
        table["faces"] = faces.astype(np.uint32).ravel()
        table.update()
        return mesh

    def properties() -> Any:
        own = mi.Properties()
        own["mesh_bsdf"] = mi.load_dict({"type": "twosided", "bsdf": diffuse(0.7, 0.7, 0.7)})
        return own

    seen = photograph(scene(box=sheet(height)))
    result = fit(renderer(box=sheet(0 * height)), seen, ["box:vertices"], starts=1, steps=400)
    found = estimate(result, "box:vertices").arrays["vertices"]
    assert result.found and found.shape == (n * n, 3)
    picture = result.pictures[0]
    top = picture.target[..., 0] > 0.29  # lit, and brighter than the floor
    first, last = (np.abs(image - picture.target)[top].mean() for image in (picture.start, picture.fit))
    rise = found[:, 2] - 0.6
    assert last < 0.4 * first, (first, last)
    assert np.corrcoef(rise, height.ravel())[0, 1] > 0.6 and 0.12 < rise.max() < 0.4


@pytest.mark.parametrize(
    ("material", "names"),
    [
        ({"type": "principled", "roughness": 0.4}, {"base_color": [0.7, 0.3, 0.2], "roughness": [0.6]}),
        ({"type": "roughplastic", "alpha": 0.2}, {"diffuse_reflectance": [0.6, 0.4, 0.2]}),
    ],
    ids=["principled", "roughplastic"],
)
def test_materials_that_recordings_cannot_change(material: dict[str, Any], names: dict[str, list[float]]) -> None:
    """They read parameters back when these change, or tables are made of them."""
    true = {name: value[0] if len(value) == 1 else {"type": "rgb", "value": value} for name, value in names.items()}
    seen = photograph(scene(box={**box(0), "bsdf": {**material, **true}}))
    grey = {name: {"type": "rgb", "value": [0.5] * 3} for name, value in names.items() if len(value) == 3}
    start = renderer(box={**box(0), "bsdf": {**material, **grey}})
    result = fit(start, seen, [f"box.bsdf.{name}" for name in names], starts=2, tries=1)
    for name, value in names.items():
        np.testing.assert_allclose(estimate(result, f"box.bsdf.{name}").arrays["value"], value, rtol=0.1, atol=0.02)
    # The scene has its values back.
    table = mi.traverse(start.data.scene)
    for name in grey:
        np.testing.assert_allclose(np.array(table[f"box.bsdf.{name}.value"]).ravel(), 0.5)

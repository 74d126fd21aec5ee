"""Images through the films of Mitsuba: filters, borders, crop windows, batches of cameras, lenses; against `direct`."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from integrator_scenes import camera, floor, render, shadowmap, small_scene

from shadowmap_dr import Renderer, ShadowmapError
from shadowmap_dr.rendering.film.film import Margin, develop
from shadowmap_dr.scene.sensor import sensors_of

SIZE = 32
# Shadows are not what is measured here: their edges are sharper than a pixel.
SHARP = {"shadow_map_resolution": 512}
CROP = {"crop_offset_x": 6, "crop_offset_y": 9, "crop_width": 20, "crop_height": 14}
FILTERS = ("tent", "gaussian", "mitchell", "catmullrom", "lanczos")


def filtered(name: str, size: int = SIZE, **film: Any) -> dict[str, Any]:
    return camera(size, rfilter={"type": name}, **film)


def batch(name: str, **film: Any) -> dict[str, Any]:
    other = mi.ScalarTransform4f().look_at([-2, -2, 4], [0, 0, 0], [0, 0, 1])
    film = {"width": 2 * SIZE, "height": SIZE, "pixel_format": "rgb", "rfilter": {"type": name}, **film}
    return {"type": "batch", "film": {"type": "hdrfilm", **film}, "a": camera(), "b": {**camera(), "to_world": other}}


def traced(scene: Any, spp: int = 1024) -> np.ndarray:
    return render(scene, mi.load_dict({"type": "direct"}), spp=spp)


def rmse(image: np.ndarray, reference: np.ndarray, where: Any = ...) -> float:
    """Root mean square of the difference over that of the reference."""
    return float(np.sqrt(np.mean((image - reference)[where] ** 2) / np.mean(reference[where] ** 2)))


def edges(image: np.ndarray) -> np.ndarray:
    """Pixels (H, W) that differ from one of those beside them."""
    grey = np.pad(image.mean(2), 1, mode="edge")
    shifted = [np.roll(grey, shift, (0, 1)) for shift in np.ndindex(3, 3)]
    return (np.ptp(shifted, axis=0) > 0.02)[2:, 2:]


def frame(image: np.ndarray, width: int = 2) -> np.ndarray:
    """The outermost pixels (H, W) of an image."""
    inside = np.zeros(image.shape[:2], bool)
    inside[width:-width, width:-width] = True
    return ~inside


def textured_floor() -> dict[str, Any]:
    """A floor of sharp squares, so that there is something to filter everywhere."""
    texture = mi.Bitmap(np.random.default_rng(1).uniform(0.1, 0.9, (24, 24, 3)).astype(np.float32))
    reflectance = {"type": "bitmap", "bitmap": texture, "raw": True, "filter_type": "nearest"}
    return floor(bsdf={"type": "diffuse", "reflectance": reflectance})


# ---------------------------------------------------------------------------------------------------------------- filters


@pytest.mark.parametrize("name", FILTERS)
def test_filtered_image_agrees_with_path_tracing(variant: str, name: str) -> None:
    scene = small_scene(camera=filtered(name))
    reference = traced(scene)
    edge = edges(reference)
    assert 0.1 < edge.mean() < 0.5
    image, coarse = (render(scene, shadowmap(**SHARP), spp=spp) for spp in (64, 1))
    assert rmse(image, reference, edge) < 0.012 and rmse(image, reference, ~edge) < 0.003
    assert rmse(coarse, reference, edge) < 0.065 and rmse(coarse, reference, ~edge) < 0.003
    # A box in its place is far off, so that these bounds tell filters apart.
    box = render(small_scene(camera=camera(SIZE)), shadowmap(**SHARP), spp=64)
    assert rmse(box, reference, edge) > 2.5 * rmse(image, reference, edge)


@pytest.mark.parametrize("name", ["tent", "gaussian", "lanczos"])
@pytest.mark.parametrize("window", [{}, CROP], ids=["whole", "crop"])
def test_border_is_treated_as_by_mitsuba(variant: str, name: str, window: dict[str, int]) -> None:
    images, references = {}, {}
    for border in (False, True):
        scene = small_scene(camera=filtered(name, sample_border=border, **window), floor=textured_floor())
        images[border], references[border] = render(scene, shadowmap(**SHARP), spp=256), traced(scene)
    seam = frame(references[True], 1)
    difference = rmse(references[False], references[True], seam)
    for border in (False, True):
        assert images[border].shape == references[border].shape
        assert rmse(images[border], references[border]) < 0.015
        assert rmse(images[border], references[border], seam) < 0.015 < 0.6 * difference


def test_box_is_left_alone(variant: str) -> None:
    plain = small_scene()
    bordered = small_scene(camera=camera(sample_border=True))
    for spp in (1, 4):
        assert np.array_equal(render(plain, spp=spp), render(bordered, spp=spp))
    (sensor,) = sensors_of(bordered.sensors()[0])
    assert sensor.border == 0


@pytest.mark.parametrize("factor", [2, 3])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_means_over_samples_and_their_derivatives(variant: str, factor: int, channels: int) -> None:
    """A box filter gives the means over the samples of each pixel. In both modes derivatives are those of NumPy's means."""
    (sensor,) = sensors_of(mi.load_dict(camera(SIZE)))
    assert sensor.filter.is_box
    generator = np.random.default_rng(factor)
    values, change, weight = (generator.normal(size=(5 * k, 7 * k, channels)).astype(np.float32) for k in (factor, factor, 1))

    def means(samples: np.ndarray) -> np.ndarray:
        return samples.reshape(5, factor, 7, factor, channels).mean((1, 3))

    t, samples = mi.Float(0), mi.TensorXf(values)
    dr.enable_grad(t)
    found = develop([mi.TensorXf(values) + t * mi.TensorXf(change)], sensor, factor)
    dr.forward(t)
    np.testing.assert_allclose(found.numpy(), means(values), atol=1e-6)
    np.testing.assert_allclose(dr.grad(found).numpy(), means(change), atol=1e-6)
    dr.enable_grad(samples)
    dr.backward(dr.sum(develop([samples], sensor, factor) * mi.TensorXf(weight), axis=None))
    expected = np.repeat(np.repeat(weight, factor, 0), factor, 1) / factor**2
    np.testing.assert_allclose(dr.grad(samples).numpy(), expected, rtol=1e-6)


def test_further_channels_are_not_filtered(variant: str) -> None:
    channels = {"aovs": "shape_index,depth"}
    box = render(small_scene(), shadowmap(**channels))
    for border in (False, True):
        image = render(small_scene(camera=camera(rfilter={"type": "gaussian"}, sample_border=border)), shadowmap(**channels))
        assert image.shape == box.shape == (64, 64, 5)
        assert np.array_equal(image[..., 3], box[..., 3]) and np.allclose(image[..., 4], box[..., 4], rtol=1e-4)
        assert not np.allclose(image[..., :3], box[..., :3], atol=0.01)


@pytest.mark.parametrize("name", ["gaussian", "mitchell"])
def test_film_holds_the_filtered_image(variant: str, name: str) -> None:
    film = filtered(name, sample_border=True, pixel_format="rgba", **CROP)
    scene = small_scene(camera=film, integrator={"type": "shadowmap", "aovs": "depth"})
    scene.integrator().render(scene, develop=False)
    assert np.allclose(scene.sensors()[0].film().develop().numpy(), mi.render(scene).numpy(), atol=1e-6)


# ---------------------------------------------------------------------------------------------------------------- batches


@pytest.mark.parametrize("border", [False, True])
def test_batch_mixes_at_the_seam_as_mitsuba_does(variant: str, border: bool) -> None:
    scene = small_scene(camera=batch("gaussian", sample_border=border), floor=textured_floor())
    image, reference = render(scene, shadowmap(**SHARP), spp=64), traced(scene)
    # Beyond the right border of a batch sensor's film Mitsuba starts its last camera's picture anew.
    columns = slice(0, 2 * SIZE - 2 if border else None)
    assert rmse(image[:, columns], reference[:, columns]) < 0.02
    seam = slice(SIZE - 1, SIZE + 1)
    assert rmse(image[:, seam], reference[:, seam]) < 0.02
    parts = []
    for single in (batch("gaussian")[key] for key in "ab"):
        alone = {**single, "film": filtered("gaussian", sample_border=border)["film"]}
        parts.append(render(small_scene(camera=alone, floor=textured_floor()), shadowmap(**SHARP), spp=64))
    separate = np.concatenate(parts, axis=1)
    assert rmse(separate[:, seam], reference[:, seam]) > 0.05


@pytest.mark.parametrize("name", ["box", "gaussian"])
def test_batch_is_squeezed_into_its_crop_window(variant: str, name: str) -> None:
    scene = small_scene(camera=batch(name, **CROP))
    reference = traced(scene)
    image = render(scene, shadowmap(**SHARP), spp=64)
    assert image.shape == reference.shape == (14, 20, 3)
    assert rmse(image, reference) < 0.015


def test_crop_window_that_cannot_be_shared_is_refused(variant: str) -> None:
    scene = small_scene(camera=batch("box", **{**CROP, "crop_width": 19}))
    with pytest.raises(ShadowmapError, match="batch sensor 'camera' has 19 columns for 2 cameras"):
        shadowmap().render(scene)


# ------------------------------------------------------------------------------------------------------------ derivatives


@pytest.mark.parametrize("name, border", [("gaussian", False), ("gaussian", True), ("lanczos", True), ("tent", False)])
def test_derivatives_of_a_filtered_image(variant: str, name: str, border: bool) -> None:
    """The ball moves; the image is cropped so that its outline and its shadow cross the borders.

    With 16 samples a pixel, since the facets of the ball's outline make differences of images with one noisy, filter or not.
    """
    scene = small_scene(camera=filtered(name, 48, sample_border=border, **{**CROP, "crop_offset_x": 14, "crop_offset_y": 10}))
    renderer = Renderer.from_scene(scene, shadow_map_resolution=64, shadow_filter_size=5)
    base = mi.traverse(scene)["ball.vertex_positions"]
    direction = mi.Float(np.tile(np.float32([1.0, 0.5, 0.2]), dr.width(base) // 3))

    def image(x: Any) -> Any:
        return renderer.render({"ball": base + x * direction}, spp=16)

    weights = np.random.default_rng(0).normal(size=(*image(mi.Float(0)).shape[:2], 1)).astype(np.float32)
    x = mi.Float(0.0)
    dr.enable_grad(x)
    dr.set_grad(x, 1.0)
    forward = dr.forward_to(image(x)).numpy()
    step = 0.01
    differences = (image(mi.Float(step)).numpy() - image(mi.Float(-step)).numpy()) / (2 * step)
    assert np.sum(forward * differences) / np.sum(differences**2) == pytest.approx(1, abs=0.05)
    assert np.sum(forward * differences) > 0.97 * np.linalg.norm(forward) * np.linalg.norm(differences)

    x = mi.Float(0.0)
    dr.enable_grad(x)
    dr.backward(dr.sum(image(x) * mi.TensorXf(weights)))
    scale = float(np.abs(forward * weights).sum())
    assert dr.grad(x)[0] == pytest.approx(float(np.sum(forward * weights)), abs=1e-4 * scale)


def test_filtered_step_is_recorded(variant: str) -> None:
    """A frozen function replays with other vertices what it gives without being frozen."""
    scene = small_scene(camera=filtered("gaussian", sample_border=True))
    renderer = Renderer.from_scene(scene, shadow_map_resolution=64)
    base = mi.Float(dr.detach(mi.traverse(scene)["ball.vertex_positions"]))

    def step(x: Any, base: Any, renderer: Renderer) -> tuple[Any, Any]:
        dr.enable_grad(x)
        loss = dr.mean(renderer.render({"ball": base + x}, spp=4) ** 2)
        dr.backward(loss)
        return dr.detach(loss), dr.grad(x)

    frozen = dr.freeze(step)
    for k in range(4):
        x = mi.Float(np.random.default_rng(k).normal(size=dr.width(base)) * 0.01)
        (loss, gradient), (expected, true) = frozen(mi.Float(x), base, renderer), step(mi.Float(x), base, renderer)
        assert np.allclose(loss.numpy().ravel(), expected.numpy().ravel(), rtol=1e-5)
        assert np.allclose(gradient.numpy(), true.numpy(), atol=1e-4 * np.abs(true.numpy()).max())
    assert frozen.n_recordings <= 2


# ----------------------------------------------------------------------------------------------------------------- lenses


def lens(aperture: float) -> dict[str, Any]:
    return {**camera(SIZE), "type": "thinlens", "aperture_radius": aperture, "focus_distance": 4.0}


def test_thin_lens_is_a_pinhole_with_one_warning(variant: str) -> None:
    scene = small_scene(camera=lens(0.2))
    integrator = shadowmap()
    with pytest.warns(UserWarning, match="'camera' is a thin lens with an aperture_radius of 0.2.*pinhole") as caught:
        image = render(scene, integrator)
        render(scene, integrator)
    assert len(caught) == 1
    assert np.allclose(image, render(small_scene(camera=camera(SIZE))), atol=1e-5)


def test_each_lens_that_is_not_in_the_scene_warns_once(variant: str) -> None:
    scene, integrator = small_scene(), shadowmap()
    strangers = [mi.load_dict(lens(aperture)) for aperture in (0.1, 0.3)]
    with pytest.warns(UserWarning, match="thin lens") as caught:
        for sensor in (*strangers, *strangers):
            render(scene, integrator, sensor=sensor)
    assert [("of 0.1" in str(w.message), "of 0.3" in str(w.message)) for w in caught] == [(True, False), (False, True)]


def test_closed_aperture_and_pinholes_do_not_warn(variant: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        render(small_scene(camera=lens(0.0)))
        render(small_scene())


def test_cameras_of_a_batch_warn_by_name(variant: str) -> None:
    film = {"type": "hdrfilm", "width": 64, "height": 32, "rfilter": {"type": "box"}}
    with pytest.warns(UserWarning, match="'b' is a thin lens") as caught:
        render(small_scene(camera={"type": "batch", "film": film, "a": camera(), "b": lens(0.1)}))
    assert len(caught) == 1


def test_records_with_other_films(variant: str) -> None:
    """A camera record's filter and border may be replaced, like all else in it."""
    renderer = Renderer.from_scene(small_scene(camera=camera(SIZE)))
    (box,) = renderer.data.sensors[0]
    (gaussian,) = sensors_of(mi.load_dict(filtered("gaussian")))
    image = renderer.render(sensor=replace(box, filter=gaussian.filter, sample_border=True)).numpy()
    assert np.allclose(image, render(small_scene(camera=filtered("gaussian", sample_border=True))), atol=0.02)
    assert not np.allclose(image, renderer.render().numpy(), atol=0.02)


def test_films_larger_than_the_rasterizer_are_refused(variant: str) -> None:
    with pytest.raises(ShadowmapError, match="A picture of 5000 x 4 pixels is too large: render it in crop windows of 4096"):
        Renderer.from_scene(small_scene(camera=camera(width=5000, height=4)))


@pytest.mark.parametrize("name", ["box", "gaussian"])
@pytest.mark.parametrize("spp", [1, 4])
def test_crop_windows_are_pieces_of_the_film(variant: str, name: str, spp: int) -> None:
    """Image and derivatives; also of a single pixel that an edge passes by."""

    def piece(**window: int) -> tuple[np.ndarray, np.ndarray]:
        seen = filtered(name, 32, **{f"crop_{key}": value for key, value in window.items()})
        renderer = Renderer.from_scene(small_scene(camera=seen), shadow_method="none")
        x = mi.Float(0)
        dr.enable_grad(x)
        moved = renderer.data.geometry.shape_positions("ball") + mi.Vector3f(1, 0, 0) * x
        image = renderer.render(vertex_positions={"ball": moved}, spp=spp)
        dr.forward(x)
        return np.array(image), np.array(dr.grad(image))

    image, derivative = piece()
    if name != "box":  # whose samples beyond a window the film does not want
        image, derivative = image[8:24, 8:24], derivative[8:24, 8:24]
        found, other = piece(width=16, height=16, offset_x=8, offset_y=8)
        inner = slice(3, -3), slice(3, -3)
        np.testing.assert_allclose(found[inner], image[inner], atol=1e-5)
        np.testing.assert_allclose(other[inner], derivative[inner], atol=1e-4)
        return
    row, column = np.unravel_index(np.abs(derivative).sum(2).argmax(), (32, 32))
    for x, y, width, height in ((0, 0, 16, 20), (16, 0, 16, 20), (0, 20, 16, 12), (16, 20, 16, 12), (column, row, 1, 1)):
        found, other = piece(width=width, height=height, offset_x=int(x), offset_y=int(y))
        np.testing.assert_allclose(found, image[y : y + height, x : x + width], atol=1e-5)
        np.testing.assert_allclose(other, derivative[y : y + height, x : x + width], atol=1e-4)


def test_crop_windows_have_as_many_samples_as_they_would_have_alone(variant: str) -> None:
    """Pixels around them are left out where there is no room for these."""
    (seen,) = sensors_of(mi.load_dict(camera(4096, crop_width=2048, crop_height=1024, crop_offset_x=5, crop_offset_y=7)))
    assert Margin.of((seen,), 1) == Margin(1, 1, 1, 1) and Margin.of((seen,), 2) == Margin()
    corner = replace(seen, crop_offset=(0, 3072))
    assert Margin.of((corner,), 1) == Margin(0, 1, 1, 0)

"""Residuals and losses of users: derivatives against differences, fits that colours do not manage, and what is refused."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
import pytest
from fitting_scenes import OPTIONS, box, camera, diffuse, floor, rgb, scene_of

from shadowmap_dr import Renderer, fitting
from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.fitting import Fit, FitResult, Own, SceneChange, make_target
from shadowmap_dr.fitting.comparison import Observation
from shadowmap_dr.fitting.gains import Gain
from shadowmap_dr.fitting.judgement import EXPLAINED, unexplained
from shadowmap_dr.fitting.losses import Loss
from shadowmap_dr.fitting.objective import Objective
from shadowmap_dr.fitting.own_losses import OwnLoss, OwnResiduals
from shadowmap_dr.jit.types import Float, TensorXf

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.float32]
SHAPE = (20, 24, 3)
# Corrections, which take Mitsuba's kernels, have tests of their own.
fit, prepared = partial(fitting.fit, correct=False), partial(fitting.prepared, correct=False)


@pytest.fixture(autouse=True)
def one_backend() -> None:
    mi.set_variant("llvm_ad_rgb")


# ------------------------------------------------------------------------------------------------------- functions of users


def logarithms(image: TensorXf, picture: TensorXf) -> TensorXf:
    return dr.log(image + 0.1) - dr.log(picture + 0.1)


def edges(image: TensorXf, picture: TensorXf) -> TensorXf:
    """Gradients of logarithms, (H - 1, W - 1, 6)."""
    difference = logarithms(image, picture)
    across = difference[1:, 1:] - difference[1:, :-1]
    return dr.concat([across, difference[1:, 1:] - difference[:-1, 1:]], axis=2)


def blurred(image: TensorXf, picture: TensorXf) -> TensorXf:
    kernel = mi.Float(1, 2, 1) / 4
    difference = dr.convolve(image - picture, kernel, axis=0, boundary="nearest")
    return dr.convolve(difference, kernel, axis=1, boundary="nearest")


def chromaticity(image: TensorXf, picture: TensorXf) -> TensorXf:
    """Shares of red and green."""
    shares = [one / (dr.sum(one, axis=2)[:, :, None] + 0.05) for one in (image, picture)]
    return (shares[0] - shares[1])[:, :, :2]


def flat(image: TensorXf, picture: TensorXf) -> Float:
    """Brightness of the rows: residuals that are no image."""
    return dr.sum(image - picture, axis=(1, 2)).array


FUNCTIONS: list[Callable[[TensorXf, TensorXf], Any]] = [logarithms, edges, blurred, chromaticity, flat]


def observation(seed: int = 1, **gain: Any) -> Observation:
    generator = np.random.default_rng(seed)
    weight = np.ones(SHAPE[:2], np.float32)
    weight[:3] = 0
    return Observation(generator.uniform(0.1, 1, SHAPE).astype(np.float32), weight, Gain(**gain))


class FakeView:
    """Images that are smooth functions of numbers: a_0 exp(x . A)."""

    def __init__(self, count: int = 3) -> None:
        generator = np.random.default_rng(0)
        self.count, self.values = count, list[Float]()
        self._base, self._slopes = generator.uniform(0.2, 1, SHAPE), generator.normal(size=(count, *SHAPE))

    def scene_at(self, x: Array) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext()

    def image(self, x: Array) -> Image:
        return np.asarray(self._base * np.exp(np.tensordot(x[: self.count], self._slopes, 1)), np.float32)

    def derivative(self, x: Array, number: int) -> tuple[Image, Image]:
        image = self.image(x)
        return image, np.asarray(image * self._slopes[number], np.float32)

    def derivatives(self, x: Array) -> Image:
        return np.array([self.derivative(x, k)[1] for k in range(self.count)])


@pytest.mark.parametrize("function", FUNCTIONS)
def test_derivatives_of_residuals_are_those_of_differences(function: Callable[..., Any]) -> None:
    """By the scene's numbers, and by an exposure and a vignetting."""
    view: Any = FakeView()
    objective = Objective([view], [observation(colours=1, vignetting=True)], np.full(5, np.inf), Loss(), function)
    x = np.array([0.1, -0.05, 0.1, 0.2, -0.3])
    columns = objective.at(x).columns()[0].astype(np.float64)
    assert columns.shape == (5, objective.at(x).residuals[0].size)
    for k, step in enumerate(1e-2 * np.eye(5)):
        above, below = (objective.at(x + sign * step).residuals[0].astype(np.float64).ravel() for sign in (1, -1))
        expected = (above - below) / 2e-2
        np.testing.assert_allclose(columns[k], expected, atol=2e-3 * np.abs(expected).max() + 1e-3)


@pytest.mark.parametrize("function", FUNCTIONS)
def test_adjoints_are_those_of_derivatives(function: Callable[..., Any]) -> None:
    """<J change, adjoint> = <change, J^T adjoint>."""
    compared, generator = OwnResiduals(function, observation()), np.random.default_rng(5)
    image, change = (generator.uniform(0.1, 1, SHAPE).astype(np.float32) for _ in range(2))
    forward = compared.derivatives(image, [change])[0]
    adjoint = generator.normal(size=forward.shape).astype(np.float32)
    ours = float((forward * adjoint).sum(dtype=np.float64))
    assert float((change * compared.adjoint(image, adjoint)).sum(dtype=np.float64)) == pytest.approx(ours, rel=1e-3, abs=1e-3)


def test_residuals_are_shares_of_what_the_picture_shows() -> None:
    seen = observation()
    compared = OwnResiduals(lambda image, picture: image - picture, seen)
    counts = seen.weight > 0
    mean = seen.image[counts].mean(0)
    size = np.sqrt(np.square(seen.image - mean)[counts].mean())
    image = np.full(SHAPE, 0.4, np.float32)
    expected = np.where(counts[..., None], (image - seen.image) / size, 0)
    np.testing.assert_allclose(compared.residuals(image), expected, atol=1e-5)
    np.testing.assert_array_equal(compared.weight[..., 0], seen.weight)
    # Rows 0 to 2 are masked: edges between rows 2 and 3 see one of them.
    np.testing.assert_array_equal(
        OwnResiduals(edges, seen).weight, np.float32(np.arange(19)[:, None, None] >= 3) * np.ones((1, 23, 1))
    )


def test_pixels_that_do_not_count_are_seen_by_no_function() -> None:
    seen, image = observation(), np.full(SHAPE, 0.4, np.float32)
    other = image.copy()
    other[:3] = 7
    for function in FUNCTIONS:
        compared = OwnResiduals(function, seen)
        np.testing.assert_array_equal(compared.residuals(image), compared.residuals(other))
        assert (compared.adjoint(image, np.ones_like(compared.residuals(image)))[:3] == 0).all()


# --------------------------------------------------------------------------------------------------------------------- fits

FILM = {"width": 64, "height": 48}
TRUE = (0.35, -0.2)


@pytest.fixture(scope="module")
def picture() -> Image:
    mi.set_variant("llvm_ad_rgb")
    return photograph(scene_of(camera=camera(film=FILM), box=box(*TRUE)))


def photograph(scene: mi.Scene) -> Image:
    return np.array(mi.render(scene, spp=64, integrator=mi.load_dict({"type": "direct"})))[..., :3]


def renderer() -> Renderer:
    """With shadows as sharp as Mitsuba's: functions of edges see the difference."""
    return Renderer.from_scene(scene_of(camera=camera(film=FILM), box=box(0)), **{**OPTIONS, "shadow_map_resolution": 256})


def unevenly_lit(picture: Image) -> Image:
    """As by another lamp, twenty times as bright on the right as on the left, and by another tone curve."""
    x = np.linspace(-1.5, 1.5, picture.shape[1], dtype=np.float32)
    return np.asarray((0.5 * picture * np.exp(x)[None, :, None]) ** 0.7, np.float32)


def place(result: FitResult) -> npt.NDArray[np.float64]:
    return result.estimates[0].values


def test_edges_of_logarithms_find_what_colours_do_not(picture: Image) -> None:
    taken = unevenly_lit(picture)
    options: dict[str, Any] = {"starts": 4, "tries": 1}
    by_colours = fit(renderer(), taken, "box:translation:xy", exposure=True, **options)
    assert not by_colours.found or np.abs(place(by_colours) - TRUE).max() > 0.05
    found = fit(renderer(), taken, "box:translation:xy", residuals=edges, **options)
    assert found.found and np.abs(place(found) - TRUE).max() < 0.02
    width = found.estimates[0].half_width
    assert width is not None and (width > np.abs(place(found) - TRUE)).all() and width.max() < 0.1
    assert found.settings["residuals"] == "edges"


def test_parametrisations_and_masks_go_with_residuals(picture: Image) -> None:
    """Along a rail, with half of the picture masked."""

    def rail(numbers: list[Float], change: SceneChange) -> None:
        (way,) = numbers
        change.move(["box"], mi.Matrix4f([1, 0, 0, 0.35 * way], [0, 1, 0, -0.2 * way], [0, 0, 1, 0], [0, 0, 0, 1]))

    taken, mask = unevenly_lit(picture), np.ones(picture.shape[:2])
    taken[:, :10], mask[:, :10] = 5, 0
    found = fit(renderer(), make_target(taken, mask), Own("rail", rail, [0.0], 1.0), residuals=edges, starts=3, tries=1)
    assert found.found and found.estimates[0].values[0] == pytest.approx(1, abs=0.05)


def test_an_exposure_that_residuals_do_not_see_moves_nothing() -> None:
    def shares(image: TensorXf, target: TensorXf) -> TensorXf:
        ours, theirs = (one / (dr.sum(one, axis=2)[:, :, None] + 1e-6) for one in (image, target))
        return ours - theirs

    lit = {"camera": camera(film=FILM), "sky": {"type": "constant", "radiance": rgb(0.3, 0.3, 0.3)}}  # nothing is black
    taken = 0.25 * photograph(scene_of(**lit, box=box(*TRUE)))
    begun = Renderer.from_scene(scene_of(**lit, box=box(0)), **OPTIONS)
    found = fit(begun, taken, "box:translation:xy", residuals=shares, exposure=True, starts=3, tries=1)
    assert found.found and np.abs(place(found) - TRUE).max() < 0.05
    assert found.words == ["exposure of the target moves nothing in the pictures."]


@pytest.mark.parametrize("function", [None, logarithms, edges, chromaticity])
def test_poses_are_judged_alike_by_all_residuals(picture: Image, function: Any) -> None:
    """True ones are found; others, by a fifth of the box and more, are not."""
    prepared_fit = prepared(renderer(), picture, "box:translation:xy", residuals=function, starts=1)
    objective, factor = prepared_fit.stages[-1].objective, prepared_fit.parameters[0].scale.factor
    true, other, unmoved = (objective.at(np.array(at) / factor) for at in (TRUE, (0.5, -0.2), (0.0, 0.0)))
    shares = [unexplained(point, objective).whole for point in (true, other, unmoved)]
    assert shares[0] < EXPLAINED < shares[1] < shares[2] + 0.1
    assert shares[2] == pytest.approx(1, abs=0.3)


def test_a_picture_of_another_scene_is_not_found(picture: Image) -> None:
    noise = np.random.default_rng(0).uniform(0, 1, picture.shape).astype(np.float32)
    result = fit(renderer(), noise, "box:translation:xy", residuals=edges, starts=2, tries=1)
    assert not result.found and "of what your residuals see in the picture" in result.words[0]
    assert "is not where the scene has it" in result.words[0]


# ------------------------------------------------------------------------------------------------------ textures and vertices


def squares(image: TensorXf, picture: TensorXf) -> Float:
    """Mean square of edges' differences, beside that of colours."""
    return dr.mean(dr.square(edges(image, picture)), axis=None).array + dr.mean(dr.square(image - picture), axis=None).array


def textured() -> Renderer:
    values = np.random.default_rng(1).uniform(0.3, 0.7, (4, 4, 3)).astype(np.float32)
    bsdf = {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True}}
    return Renderer.from_scene(scene_of(floor={**floor(), "bsdf": bsdf}, camera=camera(film=FILM)), **OPTIONS)


@pytest.mark.parametrize("functions", [{"residuals": edges}, {"loss": squares}], ids=["residuals", "loss"])
def test_gradients_by_textures_are_those_of_differences(picture: Image, functions: dict[str, Any]) -> None:
    objective = prepared(textured(), picture, "floor:texture", **functions).stages[-1].objective
    x, step, generator = np.zeros(0), 0.004, np.random.default_rng(2)
    rest = objective.views[0].values[0].numpy().copy()
    gradient = objective.gradient(x)[0].numpy()
    for _ in range(3):
        direction, costs = generator.normal(size=48).astype(np.float32), []
        for sign in (1, -1):
            objective.set_values([mi.Float(rest + sign * step * direction)])
            costs.append(objective.at(x).cost)
        assert float(gradient @ direction) == pytest.approx((costs[0] - costs[1]) / (2 * step), rel=0.02, abs=2e-5)


def test_a_texture_follows_a_loss_of_one_number() -> None:
    true = scene_of(camera=camera(film=FILM), floor={**floor(), "bsdf": diffuse(0.8, 0.3, 0.2)})
    result = fit(textured(), photograph(true), "floor:texture", loss=squares, steps=60, resolution=32)
    texels = result.estimates[0].arrays["texture"].reshape(-1, 3)
    assert np.abs(np.median(texels, axis=0) - [0.8, 0.3, 0.2]).max() < 0.02
    assert result.settings["loss"] == "squares"


def test_functions_of_pytorch_serve_as_losses_and_as_residuals(picture: Image) -> None:
    torch = pytest.importorskip("torch", reason="pip install '.[torch]'")

    @dr.wrap("drjit", "torch")
    def loss(image: Any, target: Any) -> Any:
        return torch.nn.functional.smooth_l1_loss(image, target)

    @dr.wrap("drjit", "torch")
    def residuals(image: Any, target: Any) -> Any:
        return torch.log(image + 0.1) - torch.log(target + 0.1)

    seen, change = observation(), np.random.default_rng(3).normal(size=SHAPE).astype(np.float32)
    gradient = OwnLoss(loss, seen).gradient(0.5 * seen.image)
    inside = np.where(seen.weight[..., None] > 0, seen.image, 0)
    np.testing.assert_allclose(gradient, -0.5 * inside / inside.size, atol=1e-7)
    ours, theirs = (OwnResiduals(one, seen) for one in (residuals, logarithms))
    np.testing.assert_allclose(ours.residuals(seen.image / 2), theirs.residuals(seen.image / 2), atol=1e-5)
    for one, other in zip(ours.derivatives(seen.image, [change]), theirs.derivatives(seen.image, [change]), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-4)
    found = fit(textured(), picture, "floor:texture", loss=loss, steps=9, resolution=32)
    assert found.pictures[0].error < 0.3


# ------------------------------------------------------------------------------------------------------------------ refusals


def shape_changes(image: TensorXf, picture: TensorXf) -> TensorXf:
    return (image - picture)[: 5 if dr.all(image.array == picture.array) else 4]


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (lambda image, picture: (image - picture).numpy(), "returns a numpy.ndarray: return a float array of Dr.Jit's"),
        (lambda image, picture: mi.TensorXf((image - picture).numpy()), "its result has no derivative by the image"),
        (lambda image, picture: dr.detach(image) - picture, "its result has no derivative by the image"),
        (lambda image, picture: image > picture, "return a float array of Dr.Jit's"),
        (lambda image, picture: None, "returns a builtins.NoneType"),
        (lambda image, picture: 1.0, "returns a builtins.float"),
        (lambda image, picture: (image - picture)[:0], "returns an array without entries"),
        (lambda image, picture: dr.log(image) - dr.log(picture + 0.1), "is not finite: add a small number"),
        (lambda image, picture: image / dr.mean(image, axis=None) - picture, "of a black picture is not finite"),
        (lambda image, picture: dr.maximum(image - 1000, 0), "all are zero"),
        (lambda image, picture: image @ picture, "in the function"),
        (lambda image: image, "TypeError in the function: .*positional argument"),
        (shape_changes, "return the same shape for all"),
        ("log", "'log' is no function"),
    ],
)
def test_functions_that_are_refused(function: Any, words: str) -> None:
    """In one line that names the function, before anything is recorded."""
    with pytest.raises(ShadowmapError, match=words) as caught:
        OwnResiduals(function, observation())
    assert "\n" not in str(caught.value) and re.match(r"residuals", str(caught.value))


def test_losses_that_are_refused(picture: Image) -> None:
    with pytest.raises(ShadowmapError, match="returns 1,440 numbers: return one, or give the function as residuals="):
        OwnLoss(lambda image, target: image - target, observation())
    with pytest.raises(ShadowmapError, match="loss squares: a function of one number serves textures and vertices"):
        fit(renderer(), picture, "box:translation", loss=squares)
    with pytest.raises(ShadowmapError, match="loss squares: .*give residuals="):
        fit(textured(), picture, "floor:texture", loss=squares, exposure=True)
    with pytest.raises(ShadowmapError, match="give one of them"):
        fit(textured(), picture, "floor:texture", loss=squares, residuals=edges)
    with pytest.raises(ShadowmapError, match="choose huber, l2 or l1"):
        fit(renderer(), picture, "box:translation", loss="hubert")


def test_states_of_fits_with_other_residuals_are_refused(picture: Image, tmp_path: Any) -> None:
    def begun(function: Any) -> Fit:
        return prepared(renderer(), picture, "box:translation:x", starts=1, residuals=function)

    next(iter(begun(edges).steps(tmp_path / "fit.npz")))
    for _ in zip(begun(edges).steps(tmp_path / "fit.npz"), range(12), strict=False):
        pass
    with pytest.raises(ShadowmapError, match="fit.npz"):
        begun(logarithms).steps(tmp_path / "fit.npz", resume=True)

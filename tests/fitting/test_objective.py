"""Costs of fits and their derivatives, against plain NumPy and finite differences."""

from __future__ import annotations

import contextlib
from typing import Any

import mitsuba as mi
import numpy as np
import numpy.typing as npt
import pytest
from fitting_scenes import OPTIONS, floor, scene_of
from hypothesis import given
from hypothesis import strategies as st

from shadowmap_dr import Renderer
from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.fitting.affine_image import AffineImage
from shadowmap_dr.fitting.comparison import Observation
from shadowmap_dr.fitting.gains import Gain
from shadowmap_dr.fitting.losses import Loss
from shadowmap_dr.fitting.objective import Objective
from shadowmap_dr.fitting.resolve import Resolver
from shadowmap_dr.fitting.vary import Vary
from shadowmap_dr.fitting.views import Quality, View
from shadowmap_dr.scene.sensor import ImageSize

Array = npt.NDArray[np.float64]
SHAPE = (5, 7, 3)

# ------------------------------------------------------------------------------------------------------------------- losses

LOSSES = [Loss("huber", 0.1), Loss("huber", 0.5), Loss("l2"), Loss("l1")]


@pytest.mark.parametrize("loss", LOSSES, ids=str)
def test_weights_give_squares_the_derivative_of_the_loss(loss: Loss) -> None:
    r = np.linspace(-1.5, 1.5, 1001)
    step = 1e-3
    away = np.abs(np.abs(r) - loss.limit) > 2 * step  # the derivative bends at the limit
    # Single precision: differences of a step of a thousandth.
    slope = (loss.value((r + step).astype(np.float32)).astype(float) - loss.value((r - step).astype(np.float32))) / (2 * step)
    np.testing.assert_allclose((loss.weight(r.astype(np.float32)) * r)[away], slope[away], atol=2e-4)


def test_huber_is_square_within_and_straight_beyond() -> None:
    loss = Loss("huber", 0.2)
    small, large = np.array([0, 0.1, -0.2], np.float32), np.array([0.5, -1.5], np.float32)
    np.testing.assert_allclose(loss.value(small), 0.5 * small**2, rtol=1e-6)
    np.testing.assert_allclose(loss.value(large), 0.2 * (np.abs(large) - 0.1), rtol=1e-6)
    np.testing.assert_allclose(Loss("l2").value(large), 0.5 * large**2, rtol=1e-6)
    np.testing.assert_allclose(Loss("l1").value(large) / Loss("l1").limit, np.abs(large), atol=0.003)


@pytest.mark.parametrize(("kind", "delta"), [("l3", 0.1), ("huber", 0), ("huber", -1), ("huber", np.inf), ("huber", np.nan)])
def test_losses_that_are_none(kind: Any, delta: float) -> None:
    with pytest.raises(ShadowmapError, match=r"choose huber, l2 or l1\.|give a positive number up to"):
        Loss(kind, delta)


# -------------------------------------------------------------------------------------------------------------------- gains

GAINS = [Gain(), Gain(1), Gain(3), Gain(0, True), Gain(1, True, known=2.5), Gain(3, True)]


@pytest.mark.parametrize("gain", GAINS, ids=str)
def test_derivatives_by_gains_are_those_of_differences(gain: Gain) -> None:
    image = np.random.default_rng(1).uniform(0.2, 1, SHAPE).astype(np.float32)
    g = 0.2 * np.cos(np.arange(gain.count))
    found = gain.derivatives(gain.apply(image, g), g)
    assert len(found) == gain.count
    for number, derivative in enumerate(found):
        step = 0.01 * np.eye(gain.count)[number]
        difference = (gain.apply(image, g + step).astype(float) - gain.apply(image, g - step)) / 0.02
        np.testing.assert_allclose(derivative, difference, atol=2e-4)


@given(stops=st.floats(-3, 3))
def test_exposures_are_factors(stops: float) -> None:
    image = np.random.default_rng(1).uniform(0.2, 1, SHAPE).astype(np.float32)
    np.testing.assert_allclose(Gain(1).apply(image, np.array([stops * np.log(2)])), image * 2**stops, rtol=1e-5)
    colours = Gain(3, known=0.5).apply(image, np.array([stops, 0, -stops]))
    np.testing.assert_allclose(colours, image * 0.5 * np.exp([stops, 0, -stops]), rtol=1e-5)


@pytest.mark.parametrize("shape", [(32, 48, 3), (48, 32, 3), (40, 40, 3)])
def test_vignetting_grows_to_the_corners(shape: tuple[int, int, int]) -> None:
    """With the square of the distance from the middle, in pixels."""
    image, (rows, columns) = np.ones(shape, np.float32), shape[:2]
    found = Gain(0, True).apply(image, np.array([-0.4]))[..., 0]
    y, x = np.mgrid[:rows, :columns] + 0.5
    square = (x - columns / 2) ** 2 + (y - rows / 2) ** 2
    np.testing.assert_allclose(found, 1 - 0.4 * square / (rows**2 / 4 + columns**2 / 4), atol=1e-5)


# --------------------------------------------------------------------------------------------------------------- objectives


class FakeView:
    """Images that are smooth functions of numbers: a_0 exp(x . A)."""

    def __init__(self, seed: int, count: int = 3, shape: tuple[int, int, int] = SHAPE) -> None:
        generator = np.random.default_rng(seed)
        self.count, self.values = count, []
        self._base, self._slopes = generator.uniform(0.2, 1, shape), generator.normal(size=(count, *shape))

    def scene_at(self, x: Array) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext()

    def image(self, x: Array) -> npt.NDArray[np.float32]:
        return np.asarray(self._base * np.exp(np.tensordot(x[: self.count], self._slopes, 1)), np.float32)

    def derivative(self, x: Array, number: int) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        image = self.image(x)
        return image, np.asarray(image * self._slopes[number], np.float32)

    def derivatives(self, x: Array) -> npt.NDArray[np.float32]:
        return np.array([self.derivative(x, k)[1] for k in range(self.count)])


def objective_of(loss: Loss, gains: list[Gain], prior: float = np.inf, views: list[Any] | None = None) -> Objective:
    generator = np.random.default_rng(9)
    views = views or [FakeView(k) for k in range(len(gains))]
    seen = []
    for gain in gains:
        weight = generator.uniform(0, 1, SHAPE[:2]).astype(np.float32)
        weight[0] = 0
        seen.append(Observation(generator.uniform(0.1, 1, SHAPE).astype(np.float32), weight, gain))
    count = 3 + sum(gain.count for gain in gains)
    return Objective(views, seen, np.full(count, prior), loss)


def brute_force(objective: Objective, x: Array) -> tuple[float, float, list[Array]]:
    """(cost without priors, error, residuals of each picture) in double precision."""
    cost = square = total = 0.0
    residuals = []
    for k, seen in enumerate(objective.observations):
        g = x[objective.gains[k]]
        image = objective.views[k].image(x).astype(float)
        image = image * seen.gain.factors(seen.image, g)
        brightness = np.sqrt((seen.weight[..., None] * seen.image.astype(float) ** 2).sum() / (3 * seen.weight.sum()))
        r = (image - seen.image) / brightness
        residuals.append(r)
        size, limit = np.abs(r), objective.loss.limit
        value = np.where(size <= limit, 0.5 * r**2, limit * (size - 0.5 * limit) if np.isfinite(limit) else 0)
        cost += (seen.weight[..., None] * value).sum()
        square += (seen.weight[..., None] * r**2).sum()
        total += 3 * seen.weight.sum()
    return float(cost / total), float(np.sqrt(square / total)), residuals


class CountingView(FakeView):
    """A view that counts its images and derivatives."""

    images = columns = 0

    def image(self, x: Array) -> npt.NDArray[np.float32]:
        self.images += 1
        return super().image(x)

    def derivative(self, x: Array, number: int) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        self.columns += 1
        image = super().image(x)
        return image, np.asarray(image * self._slopes[number], np.float32)


def test_derivatives_that_follow_agree_with_the_difference_of_the_images() -> None:
    view = CountingView(1)
    objective = objective_of(Loss("l2"), [Gain(1)], views=[view])
    before, after = objective.at(np.array([0.1, -0.2, 0.15, 0.1])), objective.at(np.array([0.4, 0.1, -0.15, 0.1]))
    stale = np.array(before.derivatives())
    assert after.after(before, trusted=False) is after and after.is_exact
    assert after.after(before, trusted=True) is after
    followed, step = np.array(after.derivatives()), (after.x - before.x)[:3]
    assert view.columns == 3 and not after.is_exact
    difference = after.images[0] - before.images[0]
    np.testing.assert_allclose(np.tensordot(step, followed[0], 1), difference, atol=0.02 * np.abs(difference).max())
    after.refresh()
    exact = np.array(after.derivatives())
    assert view.columns == 6 and after.is_exact
    np.testing.assert_allclose(exact[0], [view.derivative(after.x, k)[1] for k in range(3)])
    assert np.linalg.norm(followed - exact) < 0.9 * np.linalg.norm(stale - exact)


def test_images_at_the_same_numbers_are_rendered_once() -> None:
    """Gains and corrections change neither images nor derivatives; textures and vertices do."""
    view = CountingView(1)
    objective = objective_of(Loss("l2"), [Gain(1)], views=[view])
    x = np.array([0.1, -0.2, 0.15, 0.1])
    first = objective.at(x)
    first.system()
    other = objective.at(x + [0, 0, 0, 0.3])
    objective.corrections[0] = AffineImage(np.ones(SHAPE, np.float32), x, np.zeros((0, *SHAPE), np.float32), np.zeros((0, 4)))
    again = objective.at(x)
    again.system()
    assert (view.images, view.columns) == (1, 3)
    assert len({first.cost, other.cost, again.cost}) == 3
    objective.set_values([])
    objective.at(x).system()
    assert (view.images, view.columns) == (2, 6)


ALL_GAINS = [[Gain()], [Gain(1, True)], [Gain(3), Gain(1, True), Gain()]]
X = [0.1, -0.2, 0.15, 0.1, 0.05, -0.1, 0.2, -0.3]


@pytest.mark.parametrize("gains", ALL_GAINS, ids=len)
@pytest.mark.parametrize("loss", LOSSES, ids=str)
def test_cost_and_error_are_those_of_plain_loops(loss: Loss, gains: list[Gain]) -> None:
    objective = objective_of(loss, gains)
    x = np.array((X * 2)[: objective.count])
    point = objective.at(x)
    cost, error, residuals = brute_force(objective, x)
    assert point.cost == pytest.approx(cost, rel=1e-4) and point.error == pytest.approx(error, rel=1e-4)
    for ours, theirs in zip(point.residuals, residuals, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-5)


@pytest.mark.parametrize("gains", ALL_GAINS, ids=len)
@pytest.mark.parametrize("loss", LOSSES, ids=str)
def test_normal_equations_are_those_of_plain_loops(loss: Loss, gains: list[Gain]) -> None:
    """The right side is the gradient of the cost, the matrix the weighted product of derivatives of the residuals."""
    objective = objective_of(loss, gains, prior=0.3)
    count, x = objective.count, np.array((X * 2)[: objective.count])
    point = objective.at(x)
    matrix, right = point.system()
    step = 1e-4
    costs = [[brute_force(objective, x + sign * step * e) for sign in (1, -1)] for e in np.eye(count)]
    precision = objective.precision
    gradient = np.array([(after[0] - before[0]) / (2 * step) for after, before in costs]) + precision * x
    np.testing.assert_allclose(right, gradient, atol=2e-3 * np.abs(gradient).max())
    expected = np.diag(precision)
    total = 3 * sum(float(seen.weight.sum()) for seen in objective.observations)
    for k, seen in enumerate(objective.observations):
        columns = np.array([(after[2][k] - before[2][k]).ravel() / (2 * step) for after, before in costs])
        size = np.abs(brute_force(objective, x)[2][k])
        weights = seen.weight[..., None] * (np.ones(SHAPE) if np.isinf(loss.limit) else loss.limit / np.maximum(size, loss.limit))
        expected += (columns * weights.ravel()) @ columns.T / total
    np.testing.assert_allclose(matrix, expected, atol=2e-3 * np.abs(expected).max())


def test_priors_pull_to_the_scene() -> None:
    """By the square of the number in deviations: each number as if some pixels said so."""
    loose, tight = objective_of(LOSSES[0], [Gain()]), objective_of(LOSSES[0], [Gain()], prior=0.1)
    x = np.array([0.3, -0.1, 0.2])
    extra = tight.at(x).cost - loose.at(x).cost
    assert extra == pytest.approx(0.5 * float((tight.precision * x**2).sum()), rel=1e-6)
    assert (loose.precision == 0).all() and (tight.precision > 0).all()
    halved = objective_of(LOSSES[0], [Gain()], prior=0.05)
    np.testing.assert_allclose(halved.precision, 4 * tight.precision)
    # A deviation of one costs as much as usual differences of 64 pixels.
    expected = 0.5 * 64 * 0.02**2 / tight.terms
    assert tight.at(np.array([0.1, 0, 0])).cost - loose.at(np.array([0.1, 0, 0])).cost == pytest.approx(expected, rel=1e-5)


def test_masked_pixels_count_for_nothing() -> None:
    """Whatever they hold."""
    first = objective_of(LOSSES[0], [Gain(1)])
    x = np.array([0.1, -0.2, 0.15, 0.3])
    seen = first.observations[0]
    image = seen.image.copy()
    image[0] = 1000
    other = Objective(first.views, [Observation(image, seen.weight, seen.gain)], np.full(4, np.inf), first.loss)
    assert other.observations[0].brightness == seen.brightness and other.at(x).cost == first.at(x).cost
    for ours, theirs in zip(other.at(x).system(), first.at(x).system(), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_weights_are_those_of_repeated_pixels() -> None:
    """A pixel of half a weight counts as half a pixel: two halves are a whole."""
    generator, view = np.random.default_rng(5), FakeView(0)
    image = generator.uniform(0.1, 1, SHAPE).astype(np.float32)
    whole = Objective([view], [Observation(image, np.ones(SHAPE[:2], np.float32), Gain())], np.full(3, np.inf), Loss("l2"))
    half = Observation(image, np.full(SHAPE[:2], 0.5, np.float32), Gain())
    both = Objective([view, view], [half, half], np.full(3, np.inf), Loss("l2"))
    x = np.array([0.1, -0.2, 0.15])
    assert both.at(x).cost == pytest.approx(whole.at(x).cost, rel=1e-6)
    for ours, theirs in zip(both.at(x).system(), whole.at(x).system(), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-9)


def test_brightness_of_a_picture_does_not_matter() -> None:
    """Residuals are shares of it."""
    generator, view = np.random.default_rng(5), FakeView(0)
    image, weight = generator.uniform(0.1, 1, SHAPE).astype(np.float32), np.ones(SHAPE[:2], np.float32)
    x, costs = np.array([0.1, -0.2, 0.15]), []
    for factor in (1, 100):
        seen = Observation(image * np.float32(factor), weight, Gain(known=factor))
        costs.append(Objective([view], [seen], np.full(3, np.inf), Loss()).at(x).cost)
    assert costs[0] == pytest.approx(costs[1], rel=1e-4)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_images_that_are_not_finite_have_no_finite_cost(bad: float) -> None:
    """And leave no such numbers in the normal equations."""
    objective = objective_of(LOSSES[0], [Gain()])
    view = objective.views[0]
    image = view.image

    def broken(x: Array) -> npt.NDArray[np.float32]:
        found = image(x)
        found[2, 3] = bad
        return found

    view.image = broken  # type: ignore[method-assign]
    with np.errstate(invalid="ignore"):
        point = objective.at(np.zeros(3))
        assert point.cost == np.inf and point.error == np.inf
        assert all(np.isfinite(columns).all() for columns in point.columns())


# --------------------------------------------------------------------------------------------- textures and vertices, in a scene


@pytest.fixture(scope="module")
def scene_objective() -> Objective:
    """A texture of a floor and the vertices of a box, seen at 24 pixels, and a picture with another exposure."""
    mi.set_variant("llvm_ad_rgb")
    texture = np.random.default_rng(1).uniform(0.3, 0.7, (4, 4, 3)).astype(np.float32)
    bsdf = {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": mi.Bitmap(texture), "raw": True}}
    renderer = Renderer.from_scene(scene_of(floor={**floor(), "bsdf": bsdf}), **OPTIONS)
    entries = ["sun:direction", "floor:texture", "box:vertices"]
    few, many = Resolver(renderer).parameters([Vary.parse(entry) for entry in entries])
    size = ImageSize(32, 24)
    view = View(renderer, few, many, 0, size, Quality(32, 16, 64, 4, 32))
    x = np.array([0.1, -0.05])
    image = view.image(x).copy()
    y, across = np.mgrid[:24, :32]
    picture = image * (0.8 + 0.3 * np.sin(across / 5)[..., None]).astype(np.float32)
    weight = (y > 3).astype(np.float32)
    return Objective([view], [Observation(picture, weight, Gain(1, True))], np.full(4, np.inf), Loss("huber", 0.05))


def test_gradients_by_textures_are_those_of_differences(scene_objective: Objective) -> None:
    view, x = scene_objective.views[0], np.array([0.1, -0.05, 0.1, -0.1])
    rest = [one.numpy().copy() for one in view.values]
    gradient = scene_objective.gradient(x)[0].numpy()
    assert gradient.shape == (48,)
    step, generator = 0.004, np.random.default_rng(2)
    for _ in range(3):
        direction = generator.normal(size=48).astype(np.float32)
        costs = []
        for sign in (1, -1):
            scene_objective.set_values([mi.Float(rest[0] + sign * step * direction), mi.Float(rest[1])])
            costs.append(scene_objective.at(x).cost)
        scene_objective.set_values([mi.Float(one) for one in rest])
        assert float(gradient @ direction) == pytest.approx((costs[0] - costs[1]) / (2 * step), rel=0.01, abs=2e-5)


def test_gradients_by_vertices_are_those_of_differences(scene_objective: Objective) -> None:
    """Of motions as a whole, which move edges and shadows."""
    view, x = scene_objective.views[0], np.array([0.1, -0.05, 0.1, -0.1])
    rest = [one.numpy().copy() for one in view.values]
    gradient = scene_objective.gradient(x)[1].numpy().reshape(-1, 3)
    points = rest[1].reshape(-1, 3)
    moves = {"x": [1.0, 0, 0], "y": [0, 1.0, 0], "z": [0, 0, 1.0]}
    directions = {
        **{name: np.broadcast_to(move, points.shape) for name, move in moves.items()},
        "larger": points - points.mean(0),
    }
    automatic, differences = [], []
    for direction in directions.values():
        costs = []
        for sign in (1, -1):
            moved = (points + sign * 0.005 * direction).astype(np.float32)
            scene_objective.set_values([mi.Float(rest[0]), mi.Float(moved.ravel())])
            costs.append(scene_objective.at(x).cost)
        automatic.append(float((gradient * direction).sum()))
        differences.append((costs[0] - costs[1]) / 0.01)
    scene_objective.set_values([mi.Float(one) for one in rest])
    np.testing.assert_allclose(automatic, differences, atol=0.1 * np.abs(differences).max())

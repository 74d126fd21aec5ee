"""Intervals of fitted numbers, of linear problems whose covariance is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shadowmap_dr.fitting import uncertainty as module
from shadowmap_dr.fitting.objective import PRIOR_WEIGHT, Objective, Point
from shadowmap_dr.fitting.uncertainty import Uncertainty, not_told_apart, shares_of_intervals, uncertainty

Array = npt.NDArray[np.float64]
SHAPE = (112, 160, 3)
NOISE = 0.02


@dataclass
class Linear:
    """A point, and its objective, of one or several pictures with derivatives J (n, H W 3) and given residuals (H, W, 3).

    ``change``: change (H W 3,) of all images with the numbers (n,); None: as the derivatives say.
    """

    derivatives: list[Array]
    residuals: list[Array]
    recorded: list[Array]
    precision: Array
    change: Callable[[Array], Array] | None = None

    def __post_init__(self) -> None:
        self.count = len(self.derivatives[0])
        self.has_own_residuals = self.is_corrected = False
        self.terms = float(sum(residual.size for residual in self.residuals))
        self.observations = [SimpleNamespace(brightness=1.0)] * len(self.residuals)
        self.comparisons = [SimpleNamespace(derivatives=lambda image, changes: list(changes))] * len(self.residuals)

    @property
    def x(self) -> Array:
        return np.zeros(self.count)

    def at(self, x: Array) -> Any:
        changes = [x @ own if self.change is None else self.change(x) for own in self.derivatives]
        moved = [(r.ravel() + change).reshape(r.shape) for r, change in zip(self.residuals, changes, strict=True)]
        return SimpleNamespace(residuals=moved)

    def columns(self) -> list[Any]:
        return [own.astype(np.float32) for own in self.derivatives]

    def weights(self) -> list[Any]:
        return [np.ones(own.size, np.float32) for own in self.residuals]

    def system(self) -> tuple[Array, Array]:
        matrix = sum(own @ own.T for own in self.derivatives) / self.terms + np.diag(self.precision)
        return np.asarray(matrix), np.zeros(self.count)


def smooth_derivatives(count: int = 4, shape: tuple[int, int, int] = SHAPE) -> Array:
    """Images of low frequencies, different in the colours."""
    generator = np.random.default_rng(3)
    y, x = np.mgrid[: shape[0], : shape[1]] / 160
    found = []
    for _ in range(count):
        a, b, phase = generator.uniform(-9, 9), generator.uniform(-9, 9), generator.uniform(0, 6, 3)
        found.append(np.cos(a * x[..., None] + b * y[..., None] + phase).ravel())
    return np.array(found)


def made(derivatives: Any, residual: Any, recorded: Any = None, precision: Any = None) -> Linear:
    derivatives = np.asarray(derivatives, float)
    image = np.zeros(residual.shape) if recorded is None else recorded
    return Linear([derivatives], [residual], [image], np.zeros(len(derivatives)) if precision is None else precision)


def found(problem: Linear) -> Uncertainty:
    return uncertainty(cast(Point, problem), cast(Objective, problem))


@pytest.fixture
def plain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither errors that a whole picture shares, nor a factor for what blocks do not tell."""
    for name in ("DISPLACEMENT", "FACTOR", "OFFSET", "PIXEL"):
        monkeypatch.setattr(module, name, 0.0)
    monkeypatch.setattr(module, "INFLATION", 1.0)


def block_noise(generator: np.random.Generator) -> Array:
    """Noise that is equal in blocks of 16 x 16 pixels and in all colours."""
    blocks = generator.normal(scale=NOISE, size=(SHAPE[0] // 16, SHAPE[1] // 16, 1))
    return np.broadcast_to(blocks.repeat(16, 0).repeat(16, 1), SHAPE).copy()


# ------------------------------------------------------------------------------------------------------------------- widths


@pytest.mark.usefixtures("plain")
@pytest.mark.parametrize("seed", range(3))
def test_white_noise_gives_the_intervals_of_least_squares(seed: int) -> None:
    jacobian = smooth_derivatives()
    residual = np.random.default_rng(seed).normal(scale=NOISE, size=SHAPE)
    expected = 1.96 * NOISE * np.sqrt(np.diag(np.linalg.inv(jacobian @ jacobian.T)))
    np.testing.assert_allclose(found(made(jacobian, residual)).half_widths, expected, rtol=0.25)


@pytest.mark.usefixtures("plain")
@pytest.mark.parametrize("seed", range(3))
def test_noise_of_blocks_widens_the_intervals_as_it_must(seed: int) -> None:
    """By far: 768 numbers that are equal say as much as one."""
    jacobian = smooth_derivatives()
    residual = block_noise(np.random.default_rng(seed))
    inverse = np.linalg.inv(jacobian @ jacobian.T)
    rows, columns = SHAPE[0] // 16, SHAPE[1] // 16
    sums = jacobian.reshape(4, rows, 16, columns, 16, 3).sum((2, 4, 5)).reshape(4, -1)
    expected = 1.96 * NOISE * np.sqrt(np.diag(inverse @ sums @ sums.T @ inverse))
    half = found(made(jacobian, residual)).half_widths
    np.testing.assert_allclose(half, expected, rtol=0.25)
    assert (half > 5 * 1.96 * NOISE * np.sqrt(np.diag(inverse))).all()


@pytest.mark.usefixtures("plain")
def test_intervals_cover_the_errors_of_fits() -> None:
    """Of 200 fits to pictures with noise of blocks, hardly more than one in twenty is farther from the truth."""
    jacobian, generator, inside = smooth_derivatives(), np.random.default_rng(8), []
    inverse = np.linalg.inv(jacobian @ jacobian.T)
    for _ in range(50):
        noise = block_noise(generator).ravel()
        error = -inverse @ (jacobian @ noise)
        half = found(made(jacobian, (noise + error @ jacobian).reshape(SHAPE))).half_widths
        inside += (np.abs(error) < half).tolist()
    assert 0.88 < np.mean(inside) <= 0.99


@pytest.mark.usefixtures("plain")
@pytest.mark.parametrize("seed", range(3))
def test_numbers_that_one_block_tells_have_intervals(seed: int) -> None:
    """The residuals of a small thing add up to nothing where a fit ends, since it ends there."""
    generator, jacobian = np.random.default_rng(seed), np.zeros((2, *SHAPE))
    jacobian[0, 18:30, 2:14] = generator.normal(size=(12, 12, 3))
    jacobian[1, 50:60, 36:46] = 1
    jacobian = jacobian.reshape(2, -1)
    noise, inverse = generator.normal(scale=NOISE, size=SHAPE).ravel(), np.linalg.inv(jacobian @ jacobian.T)
    residual = noise - inverse @ (jacobian @ noise) @ jacobian
    expected = 1.96 * NOISE * np.sqrt(np.diag(inverse))
    np.testing.assert_allclose(found(made(jacobian, residual.reshape(SHAPE))).half_widths, expected, rtol=0.25)


@pytest.mark.usefixtures("plain")
def test_pictures_add_up() -> None:
    """Two pictures of independent noise: intervals narrow by the root of two. Sizes that no block divides are no matter."""
    shape = (50, 75, 3)
    jacobian, generator = smooth_derivatives(shape=shape), np.random.default_rng(1)
    one = [generator.normal(scale=NOISE, size=shape)]
    two = [*one, one[0]]
    single = found(Linear([jacobian], one, one, np.zeros(4))).half_widths
    double = found(Linear([jacobian, jacobian], two, two, np.zeros(4))).half_widths
    np.testing.assert_allclose(double, single / np.sqrt(2), rtol=1e-4)


def test_inflation_is_a_factor_of_the_covariance(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLACEMENT", "FACTOR", "OFFSET", "PIXEL"):
        monkeypatch.setattr(module, name, 0.0)
    problem = made(smooth_derivatives(), np.random.default_rng(0).normal(scale=NOISE, size=SHAPE))
    inflated, factor = found(problem).half_widths, module.INFLATION
    monkeypatch.setattr(module, "INFLATION", 1.0)
    np.testing.assert_allclose(inflated, np.sqrt(factor) * found(problem).half_widths, rtol=1e-6)


@pytest.mark.parametrize("name", ["DISPLACEMENT", "FACTOR", "OFFSET"])
def test_errors_that_a_picture_shares_shift_the_numbers(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """By what least squares make of them. There is no noise."""
    monkeypatch.setattr(module, "INFLATION", 0.0)
    monkeypatch.setattr(module, "PIXEL", 0.0)
    for other in {"DISPLACEMENT", "FACTOR", "OFFSET"} - {name}:
        monkeypatch.setattr(module, other, 0.0)
    jacobian, image = smooth_derivatives(), smooth_derivatives(7)[6].reshape(SHAPE)
    errors = {
        "DISPLACEMENT": [module.DISPLACEMENT * np.gradient(image, axis=axis) for axis in (0, 1)],
        "FACTOR": [module.FACTOR * image],
        "OFFSET": [np.full(SHAPE, module.OFFSET)],
    }[name]
    shifts = [np.linalg.lstsq(jacobian.T, error.ravel(), rcond=None)[0] for error in errors]
    expected = 1.96 * np.sqrt(np.square(shifts).sum(0))
    result = found(made(jacobian, np.zeros(SHAPE), image))
    np.testing.assert_allclose(result.half_widths, expected, rtol=1e-3)


@pytest.mark.usefixtures("plain")
def test_priors_narrow_the_intervals() -> None:
    jacobian = smooth_derivatives()
    residual = np.random.default_rng(0).normal(scale=NOISE, size=SHAPE)
    free = found(made(jacobian, residual)).half_widths
    # The prior's deviation is a hundredth of the interval's without it.
    precision = np.array([PRIOR_WEIGHT / residual.size / (0.01 * free[0] / 1.96) ** 2, 0, 0, 0])
    held = found(made(jacobian, residual, precision=precision)).half_widths
    assert held[0] < 0.05 * free[0] and (held[1:] > 0.3 * free[1:]).all()


def test_steps_are_measured_in_intervals() -> None:
    """A number that moves nothing has no part in them."""
    jacobian = smooth_derivatives()
    jacobian[2] = 0
    residual = np.random.default_rng(0).normal(scale=NOISE, size=SHAPE)
    problem, step = made(jacobian, residual, residual), np.array([0.01, -0.02, 5, 0.001])
    shares = shares_of_intervals(step, cast(Point, problem), cast(Objective, problem))
    np.testing.assert_allclose(shares, np.abs(step) / found(problem).half_widths, rtol=1e-6)
    assert shares[2] == 0


# ---------------------------------------------------------------------------------------------------------- what is not known


def test_numbers_that_move_nothing() -> None:
    """With a prior, too."""
    jacobian = smooth_derivatives()
    jacobian[2] = 0
    residual = np.random.default_rng(0).normal(scale=NOISE, size=SHAPE)
    for precision in (np.zeros(4), np.array([0, 0, 1e-3, 0])):
        result = found(made(jacobian, residual, residual, precision))
        assert result.idle.tolist() == [False, False, True, False]
        assert np.isinf(result.half_widths[2]) and np.isfinite(np.delete(result.half_widths, 2)).all()
        np.testing.assert_array_equal(result.correlations[2], [0, 0, 1, 0])
        others = found(made(np.delete(jacobian, 2, 0), residual, residual))
        np.testing.assert_allclose(np.delete(result.half_widths, 2), others.half_widths, rtol=1e-4)


def test_all_numbers_idle() -> None:
    result = found(made(np.zeros((2, np.prod(SHAPE))), np.ones(SHAPE)))
    assert result.idle.all() and np.isinf(result.half_widths).all() and not not_told_apart(result)


@pytest.mark.usefixtures("plain")
@pytest.mark.parametrize("sign", [1, -1])
def test_pairs_that_cannot_be_told_apart(sign: int) -> None:
    """Their effects are the same but for a thousandth, or opposite; a third number is known as well as without them."""
    jacobian = smooth_derivatives(3)
    jacobian[1] = sign * jacobian[0] + 1e-3 * jacobian[1]
    residual = np.random.default_rng(0).normal(scale=0.1, size=SHAPE)
    result = found(made(jacobian, residual))
    assert not_told_apart(result) == [(0, 1)]
    assert result.correlations[0, 1] * sign < -0.999
    assert (result.half_widths[:2] > 0.1).all() and result.half_widths[2] < 0.01


@pytest.mark.usefixtures("plain")
def test_correlated_numbers_with_narrow_intervals_are_told_apart() -> None:
    jacobian = smooth_derivatives(2)
    jacobian[1] = jacobian[0] + 0.1 * jacobian[1]
    result = found(made(jacobian, np.random.default_rng(0).normal(scale=1e-3, size=SHAPE)))
    assert abs(result.correlations[0, 1]) > 0.97 and not not_told_apart(result)


@pytest.mark.parametrize("noise", [0.1, 1e-4])
def test_numbers_of_equal_effect_are_not_determined(noise: float) -> None:
    """Up to rounding of their derivatives: the brightness of the only light, and the exposure. Small residuals do not help."""
    jacobian = smooth_derivatives(3)
    jacobian[1] = -2 * jacobian[0] * (1 + 1e-6 * np.random.default_rng(5).normal(size=jacobian[0].shape))
    result = found(made(jacobian, np.random.default_rng(0).normal(scale=noise, size=SHAPE)))
    assert np.isinf(result.half_widths[:2]).all() and result.half_widths[2] < 0.05
    assert not_told_apart(result) == [(0, 1)] and result.correlations[0, 1] > 0.999


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), near=st.sampled_from([1.0, 1e-2, 1e-5, 0.0]), count=st.integers(1, 4))
def test_correlations_are_those_of_a_covariance(seed: int, near: float, count: int) -> None:
    """Symmetric, within -1 and 1, one on the diagonal, also where derivatives depend on one another."""
    generator, shape = np.random.default_rng(seed), (20, 33, 3)
    jacobian = near * generator.normal(size=(count, np.prod(shape))) + generator.normal(size=np.prod(shape))
    jacobian *= generator.choice([0, 1e-4, 1, 100], size=(count, 1))
    result = found(made(jacobian, generator.normal(scale=0.1, size=shape), generator.normal(size=shape)))
    correlations = result.correlations
    assert np.isfinite(correlations).all() and (np.abs(correlations) <= 1).all()
    np.testing.assert_allclose(correlations, correlations.T, atol=1e-9)
    np.testing.assert_array_equal(np.diag(correlations), 1)
    assert (result.half_widths >= 0).all() and not np.isnan(result.half_widths).any()
    assert all(a < b for a, b in not_told_apart(result))


@pytest.mark.usefixtures("plain")
def test_dependent_numbers_are_measured_by_images() -> None:
    """Derivatives with errors tell two numbers apart whose sum alone changes the images."""
    true = smooth_derivatives(3)
    true[1] = true[0]
    noisy = true + np.random.default_rng(1).normal(scale=0.02, size=true.shape)
    residual = np.random.default_rng(0).normal(scale=NOISE, size=SHAPE)
    stated = made(noisy, residual)
    measured = replace(stated, change=lambda x: x @ true)
    assert found(stated).half_widths[0] < 0.1 and not not_told_apart(found(stated))
    result = found(measured)
    assert (result.half_widths[:2] > 10 * found(stated).half_widths[:2]).all() and not_told_apart(result) == [(0, 1)]
    np.testing.assert_allclose(result.half_widths[2], found(stated).half_widths[2], rtol=0.05)


@pytest.mark.usefixtures("plain")
def test_derivatives_that_point_beside_the_valley_do_not_hide_it() -> None:
    """Twice the second number makes up for the first one; derivatives state another factor, and an effect of both together."""
    true = smooth_derivatives(3)
    true[1] = 2 * true[0]
    wrong = true.copy()
    wrong[1] = 1.4 * true[0]
    wrong += np.random.default_rng(1).normal(scale=0.15, size=true.shape)
    residual = np.random.default_rng(0).normal(scale=NOISE, size=SHAPE)
    result = found(replace(made(wrong, residual), change=lambda x: x @ true))
    assert (result.half_widths[:2] > 1).all() and not_told_apart(result) == [(0, 1)]
    assert result.half_widths[2] < 0.05


@pytest.mark.usefixtures("plain")
def test_images_that_saturate_do_not_widen_intervals() -> None:
    """Two numbers have similar effects; each is told. Over long steps images change less than derivatives say."""
    true = smooth_derivatives(3)
    true[1] = true[0] + 0.5 * true[1]
    residual = np.random.default_rng(0).normal(scale=NOISE, size=SHAPE)
    linear = made(true, residual)
    bent = replace(linear, change=lambda x: 0.05 * np.tanh(x @ true / 0.05))
    np.testing.assert_allclose(found(bent).half_widths, found(linear).half_widths, rtol=0.25)

"""Minimisation of synthetic residuals, whose minima are known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shadowmap_dr.fitting.levenberg_marquardt import Damping, Limits
from shadowmap_dr.fitting.levenberg_marquardt import minimise as steps_of

Array = npt.NDArray[np.float64]


@dataclass
class Point:
    """A point of a sum of squares r(x), with derivatives J(x)."""

    x: Array
    residuals: Array
    derivatives: Array
    is_exact: bool = True

    @property
    def cost(self) -> float:
        return float(0.5 * self.residuals @ self.residuals)

    def system(self) -> tuple[Array, Array]:
        return self.derivatives.T @ self.derivatives, self.derivatives.T @ self.residuals

    def after(self, before: Point, *, trusted: bool) -> Point:
        """Derivatives of these points take no time."""
        return self

    def refresh(self) -> None:
        pass


class Following(Point):
    """A point whose derivatives follow from those of others, by secants. ``exact``: how often they were computed."""

    exact = 0

    def __init__(self, point: Point) -> None:
        super().__init__(point.x, point.residuals, point.derivatives)
        self._own: Array | None = None

    def system(self) -> tuple[Array, Array]:
        if self._own is None:
            self._own = self.derivatives
            Following.exact += 1
        return self._own.T @ self._own, self._own.T @ self.residuals

    def after(self, before: Point, *, trusted: bool) -> Point:
        if trusted:
            assert isinstance(before, Following) and before._own is not None
            step = self.x - before.x
            missed = self.residuals - before.residuals - before._own @ step
            self._own, self.is_exact = before._own + np.outer(missed, step) / (step @ step), False
        return self

    def refresh(self) -> None:
        self._own, self.is_exact = None, True


class Problem:
    """Residuals as a function of numbers; remembers where it was asked for them."""

    def __init__(self, residuals: Callable[[Array], Any], derivatives: Callable[[Array], Any]) -> None:
        self._residuals, self._derivatives, self.asked = residuals, derivatives, list[Array]()

    def at(self, x: Array) -> Point:
        self.asked.append(np.array(x))
        return Point(np.array(x), np.asarray(self._residuals(x), float), np.asarray(self._derivatives(x), float))


def minimise(
    at: Callable[[Array], Any], start: Any, limits: Limits, accepted: Callable[[Any], None] = lambda point: None
) -> tuple[Any, bool]:
    """(best point, True if steps had become small). ``accepted`` is called with each better point."""
    steps, best = steps_of(at, start, limits), start
    while True:
        try:
            best = next(steps)
        except StopIteration as end:
            return best, end.value
        accepted(best)


def rosenbrock() -> Problem:
    return Problem(lambda x: [10 * (x[1] - x[0] ** 2), 1 - x[0]], lambda x: [[-20 * x[0], 10], [-1, 0]])


def linear(matrix: Any, right: Any) -> Problem:
    matrix = np.asarray(matrix, float)
    return Problem(lambda x: matrix @ x - right, lambda x: matrix)


def free(count: int, **changes: Any) -> Limits:
    """No bounds, and ends that are far."""
    far = {"longest": 1e3, "steps": 200, "improvement": 1e-14, "shortest": 1e-10, **changes}
    return Limits(np.full(count, -np.inf), np.full(count, np.inf), **far)


@pytest.mark.parametrize("start", [(-1.2, 1), (0, 0), (3, -2), (-5, 5)])
def test_rosenbrocks_valley(start: Sequence[float]) -> None:
    problem = rosenbrock()
    best, ended = minimise(problem.at, problem.at(np.array(start, float)), free(2))
    np.testing.assert_allclose(best.x, 1, atol=1e-6)
    assert ended and len(problem.asked) < 80


def test_linear_problems_are_solved_in_few_steps() -> None:
    generator = np.random.default_rng(2)
    matrix, right = generator.normal(size=(20, 4)), generator.normal(size=20)
    problem = linear(matrix, right)
    best, _ = minimise(problem.at, problem.at(np.zeros(4)), free(4))
    np.testing.assert_allclose(best.x, np.linalg.lstsq(matrix, right, rcond=None)[0], atol=1e-8)
    assert len(problem.asked) < 12


def test_units_of_the_numbers_do_not_matter() -> None:
    """Damping is scaled by the diagonal."""
    generator = np.random.default_rng(2)
    matrix, right, scale = generator.normal(size=(20, 3)), generator.normal(size=20), np.array([100, 1, 0.1])
    one, other = linear(matrix, right), linear(matrix * scale, right)
    for steps in (1, 2):
        a, _ = minimise(one.at, one.at(np.zeros(3)), free(3, steps=steps, longest=1e9))
        b, _ = minimise(other.at, other.at(np.zeros(3)), free(3, steps=steps, longest=1e9))
        np.testing.assert_allclose(b.x * scale, a.x, rtol=1e-5)


@settings(max_examples=60)
@given(seed=st.integers(0, 1000))
def test_solutions_on_bounds_satisfy_the_kkt_conditions(seed: int) -> None:
    """Of a linear problem in a box: the gradient is zero within, and points outwards at bounds."""
    generator = np.random.default_rng(seed)
    matrix, right = generator.normal(size=(12, 4)), generator.normal(size=12) * 3
    low, high = -generator.uniform(0, 0.6, 4), generator.uniform(0, 0.6, 4)
    problem = linear(matrix, right)
    best, _ = minimise(problem.at, problem.at(np.zeros(4)), replace(free(4), low=low, high=high))
    assert all(((x >= low) & (x <= high)).all() for x in problem.asked)  # not once outside
    gradient = best.system()[1]
    size = np.abs(matrix.T @ right).max()
    at_low, at_high = best.x <= low + 1e-7, best.x >= high - 1e-7
    assert (gradient[at_low] > -1e-5 * size).all() and (gradient[at_high] < 1e-5 * size).all()
    np.testing.assert_allclose(gradient[~at_low & ~at_high], 0, atol=1e-5 * size)


def test_a_bound_in_the_valley() -> None:
    """Rosenbrock's function with x below one half: the minimum is (0.5, 0.25)."""
    problem = rosenbrock()
    limits = replace(free(2), high=np.array([0.5, np.inf]))
    best, _ = minimise(problem.at, problem.at(np.array([-1.2, 1])), limits)
    np.testing.assert_allclose(best.x, [0.5, 0.25], atol=1e-6)


def test_numbers_leave_a_bound_again() -> None:
    """The start lies at the bounds' corner that is far from the minimum within."""
    problem = linear(np.eye(2), [0.2, 0.3])
    best, _ = minimise(problem.at, problem.at(np.zeros(2)), replace(free(2), low=np.zeros(2), high=np.ones(2)))
    np.testing.assert_allclose(best.x, [0.2, 0.3], atol=1e-8)


def test_idle_numbers_stay() -> None:
    matrix = np.random.default_rng(3).normal(size=(9, 3))
    matrix[:, 1] = 0
    problem = linear(matrix, np.ones(9))
    best, _ = minimise(problem.at, problem.at(np.array([0, 0.7, 0])), free(3))
    assert best.x[1] == 0.7
    others = matrix[:, [0, 2]]
    np.testing.assert_allclose(best.x[[0, 2]], np.linalg.lstsq(others, np.ones(9), rcond=None)[0], atol=1e-8)


def test_only_idle_numbers() -> None:
    problem = linear(np.zeros((5, 2)), np.ones(5))
    best, ended = minimise(problem.at, problem.at(np.array([0.1, 0.2])), free(2))
    assert ended and best.x.tolist() == [0.1, 0.2]


def test_numbers_of_equal_effect_share_the_change() -> None:
    """A singular matrix."""
    column = np.random.default_rng(4).normal(size=8)
    problem = linear(np.stack([column, column], 1), 2 * column)
    best, _ = minimise(problem.at, problem.at(np.zeros(2)), free(2))
    assert best.cost < 1e-12
    np.testing.assert_allclose(best.x, 1, atol=1e-5)


def test_numbers_of_very_unequal_effect() -> None:
    problem = linear(np.diag([1.0, 1e-3]), [1.0, 1e-3])
    best, _ = minimise(problem.at, problem.at(np.zeros(2)), free(2))
    np.testing.assert_allclose(best.x, 1, atol=1e-4)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_candidates_without_a_cost_are_refused(bad: float) -> None:
    """Images are not finite where the first step would lead; shorter steps find the minimum."""
    limits = free(1)
    problem = Problem(lambda x: [bad if x[0] > 1.5 else np.arctan(x[0] - 1)], lambda x: [[1 / (1 + (x[0] - 1) ** 2)]])
    best, _ = minimise(problem.at, problem.at(np.array([-1.5])), limits)
    assert any(x[0] > 1.5 for x in problem.asked)
    assert best.x[0] == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_candidates_that_are_all_refused_end_the_search(bad: float) -> None:
    problem = Problem(lambda x: [1.0 if x[0] == 0 else bad], lambda x: [[1.0]])
    best, ended = minimise(problem.at, problem.at(np.zeros(1)), free(1, shortest=1e-30))
    assert ended and best.x[0] == 0 and best.cost == 0.5 and len(problem.asked) < 30


def test_a_start_without_a_cost_is_left() -> None:
    """Its derivatives are those of the other pixels."""

    class Infinite(Point):
        cost = np.inf  # type: ignore[assignment]

    problem = linear(np.eye(2), [0.2, 0.3])
    best, _ = minimise(problem.at, Infinite(np.zeros(2), -np.array([0.2, 0.3]), np.eye(2)), free(2))
    np.testing.assert_allclose(best.x, [0.2, 0.3], atol=1e-6)


@settings(max_examples=60)
@given(seed=st.integers(0, 1000))
def test_each_accepted_point_is_better(seed: int) -> None:
    """With derivatives that are wrong by a third, too."""
    generator = np.random.default_rng(seed)
    wrong = generator.uniform(0.67, 1.5, (2, 2))
    problem = Problem(lambda x: [10 * (x[1] - x[0] ** 2), 1 - x[0]], lambda x: wrong * np.array([[-20 * x[0], 10], [-1, 0]]))
    start = problem.at(generator.normal(size=2))
    accepted: list[Point] = []
    best, _ = minimise(problem.at, start, free(2, steps=30), accepted.append)
    costs = [start.cost, *(point.cost for point in accepted)]
    assert all(after < before for before, after in zip(costs[:-1], costs[1:], strict=True))
    assert best.cost == costs[-1]


def test_derivatives_follow_from_those_before() -> None:
    """The same minimum, with derivatives at fewer points."""
    curved = Problem(
        lambda x: [x[0] + 0.1 * x[1] ** 2 - 1, x[1] - 0.1 * x[0] ** 2 - 2, x[0] * x[1] / 10],
        lambda x: [[1, 0.2 * x[1]], [-0.2 * x[0], 1], [x[1] / 10, x[0] / 10]],
    )
    Following.exact, accepted = 0, list[Point]()
    best, ended = minimise(
        lambda x: Following(curved.at(x)), Following(curved.at(np.zeros(2))), free(2, longest=0.3), accepted.append
    )
    expected, _ = minimise(curved.at, curved.at(np.zeros(2)), free(2))
    np.testing.assert_allclose(best.x, expected.x, atol=1e-5)
    assert ended and Following.exact < 0.6 * len(accepted)


@pytest.mark.parametrize("start", [(-1.2, 1), (0, 0), (3, -2), (-5, 5)])
def test_derivatives_that_follow_find_the_end_of_a_valley(start: Sequence[float]) -> None:
    problem = rosenbrock()
    best, ended = minimise(lambda x: Following(problem.at(x)), Following(problem.at(np.array(start, float))), free(2))
    np.testing.assert_allclose(best.x, 1, atol=1e-5)
    assert ended


# -------------------------------------------------------------------------------------------------------------------- stops


def test_steps_are_counted() -> None:
    problem, accepted = rosenbrock(), list[Point]()
    _, ended = minimise(problem.at, problem.at(np.array([-1.2, 1])), free(2, steps=3), accepted.append)
    assert not ended and len(accepted) == 3
    at = np.array([-1.2, 1])
    best, ended = minimise(problem.at, problem.at(at), free(2, steps=0))
    assert not ended and best.x.tolist() == at.tolist()


def test_steps_with_derivatives_that_follow_count_less() -> None:
    problem, accepted = linear(np.eye(2), [100.0, 50.0]), list[Point]()
    start = Following(problem.at(np.zeros(2)))
    minimise(lambda x: Following(problem.at(x)), start, free(2, longest=0.3, steps=3), accepted.append)
    assert 3 < len(accepted) <= 12


def test_no_derivatives_are_computed_after_the_last_step() -> None:
    problem = linear(np.eye(2), [100.0, 50.0])
    Following.exact, start = 0, Following(problem.at(np.zeros(2)))
    minimise(lambda x: Following(problem.at(x)), start, free(2, longest=0.3, steps=1))
    assert Following.exact == 1


def test_steps_are_no_longer_than_allowed() -> None:
    problem, accepted = linear(np.eye(2), [10.0, 5.0]), list[Point]()
    start = problem.at(np.zeros(2))
    minimise(problem.at, start, free(2, longest=0.3, steps=4), accepted.append)
    lengths = [np.abs(b.x - a.x).max() for a, b in zip([start, *accepted[:-1]], accepted, strict=True)]
    np.testing.assert_allclose(lengths, 0.3)
    np.testing.assert_allclose(accepted[0].x, 0.3)


def test_a_number_that_runs_away_does_not_hold_up_the_others() -> None:
    """The first one hardly matters; the second is at its best value after one step, where the first has gone as far as it may."""
    problem, accepted = linear([[1e-3, 0], [0.01, 1.0]], [1.0, 0.2]), list[Point]()
    minimise(problem.at, problem.at(np.zeros(2)), free(2, longest=0.3, steps=1), accepted.append)
    np.testing.assert_allclose(accepted[0].x, [0.3, 0.2 - 0.01 * 0.3], rtol=2e-3)


def test_small_improvements_end_the_search() -> None:
    """A cost of which hardly any can be removed."""
    problem, accepted = linear([[1.0], [0.0]], [1.0, 100.0]), list[Point]()
    best, ended = minimise(problem.at, problem.at(np.zeros(1)), free(1, improvement=1e-3), accepted.append)
    assert ended and len(accepted) == 1 and best is accepted[0]


def test_small_steps_end_the_search() -> None:
    problem, accepted = linear(np.eye(1), [1e-6]), list[Point]()
    best, ended = minimise(problem.at, problem.at(np.zeros(1)), free(1, shortest=1e-5), accepted.append)
    assert ended and not accepted and best.x[0] == 0 and len(problem.asked) == 1


def test_steps_that_promise_little_are_not_taken() -> None:
    """A tenth of the cost can be removed."""
    problem = linear([[1.0], [0.0]], [1.0, 3.0])
    best, ended = minimise(problem.at, problem.at(np.zeros(1)), free(1, worth=0.11))
    assert ended and best.x[0] == 0 and len(problem.asked) == 1
    best, _ = minimise(problem.at, problem.at(np.zeros(1)), free(1, worth=0.09))
    assert best.x[0] == pytest.approx(1, abs=1e-2)


def test_dampings_after_failures() -> None:
    """Candidates are refused, and steps become shorter, until the damping is too large."""
    problem = Problem(lambda x: [1.0 if x[0] == 0 else 2.0], lambda x: [[1.0]])
    damping = Damping(first=1e-3, worse=10.0, failed=0.5, most=100.0)
    minimise(problem.at, problem.at(np.zeros(1)), free(1, damping=damping, dares=0))
    np.testing.assert_allclose(np.ravel(problem.asked), [0, *(-1 / (1 + d) for d in (1e-3, 0.5, 5, 50))], rtol=1e-6)


def test_points_that_follow_may_have_other_derivatives() -> None:
    """Derivatives that are too large by a half make steps too short; the first step tells."""
    problem = Problem(lambda x: [x[0] - 1], lambda x: [[1.5]])

    class Corrected(Point):
        def after(self, before: Point, *, trusted: bool) -> Point:
            change = (self.residuals - before.residuals) / (self.x - before.x)
            return Corrected(self.x, self.residuals, change[None])

    def at(x: Array) -> Corrected:
        point = problem.at(x)
        return Corrected(point.x, point.residuals, point.derivatives)

    steps = list(steps_of(at, at(np.zeros(1)), free(1)))
    assert steps[0].x[0] == pytest.approx(2 / 3, abs=1e-2) and steps[1].x[0] == pytest.approx(1, abs=1e-3)


def test_differences_of_rounding_end_the_search() -> None:
    """Candidates that are worse by no more than the improvement that counts: no shorter steps are tried, but two full ones."""
    problem = Problem(lambda x: [1 + 1e-6 * (x[0] != 0)], lambda x: [[1.0]])
    best, ended = minimise(problem.at, problem.at(np.zeros(1)), free(1, improvement=1e-4))
    assert ended and best.x[0] == 0
    np.testing.assert_allclose(np.ravel(problem.asked), [0, -1, -1, -2], atol=0.01)


@pytest.mark.parametrize("height", [0.3, 0.5])
def test_jumps_of_the_loss_are_overcome(height: float) -> None:
    """As those of images whose shadow maps are fitted anew: the loss is lower behind them."""
    problem = Problem(lambda x: [x[0] - 1, height * (x[0] > 0.2)], lambda x: [[1.0], [0.0]])
    best, _ = minimise(problem.at, problem.at(np.array([0.1])), free(1, longest=0.05))
    assert best.x[0] == pytest.approx(1, abs=1e-6)


def test_jumps_to_a_higher_loss_are_not_taken() -> None:
    problem = Problem(lambda x: [x[0] - 1, 2.0 * (x[0] > 0.2)], lambda x: [[1.0], [0.0]])
    best, ended = minimise(problem.at, problem.at(np.array([0.1])), free(1, longest=0.05))
    assert ended and best.x[0] == pytest.approx(0.2, abs=0.01)


def test_no_numbers() -> None:
    problem = Problem(lambda x: [1.0], lambda x: np.zeros((1, 0)))
    best, ended = minimise(problem.at, problem.at(np.zeros(0)), free(0))
    assert ended and best.cost == 0.5

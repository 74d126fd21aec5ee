"""Least squares of differences: linear models with and without noise, damped steps, averages over blocks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr import Renderer
from shadowmap_dr.experiments.pose.least_squares import Difference, Differences, Linear, mean_square
from shadowmap_dr.experiments.pose.scene import PoseProblem, make_problem
from shadowmap_dr.fitting.levenberg_marquardt import Limits, after_step, minimise, promised
from shadowmap_dr.fitting.motion_parameters import ShapeMotion
from shadowmap_dr.fitting.targets import make_target
from shadowmap_dr.fitting.vary import Vary
from shadowmap_dr.fitting.views import Quality

NEAR = np.array([0.05, 0.02, -0.03])
FREE = Limits(np.full(3, -np.inf), np.full(3, np.inf))


@pytest.fixture(scope="module")
def problem(tmp_path_factory: pytest.TempPathFactory) -> PoseProblem:
    mi.set_variant("llvm_ad_rgb")
    return make_problem("spot", 32, work=tmp_path_factory.mktemp("spot"))


def differences(problem: PoseProblem, reference: np.ndarray, side: int, spp: int, block: int = 1) -> Differences:
    motion = ShapeMotion(Vary("object", "pose"), 1.0, ("ry", "tx", "ty"), ("object",), np.zeros(3))
    quality = Quality(side, spp, 64, 16, 64)
    return Differences(Renderer.from_scene(problem.scene), motion, make_target(reference), quality, block)


def test_a_step_solves_a_linear_problem_and_keeps_its_promise() -> None:
    generator = np.random.default_rng(1)
    columns, truth = generator.normal(size=(3, 500)), np.array([0.1, -0.05, 0.2])
    difference = -truth @ columns
    matrix, right = Linear(columns).system(difference)
    step = after_step(matrix, right, 0.0, np.zeros(3), FREE)
    np.testing.assert_allclose(step, truth, rtol=1e-6)
    assert promised(matrix, right, step) == pytest.approx(mean_square(difference))
    assert promised(matrix, right, -step) < 0
    # Along other steps, too, the promise is the change of the mean square.
    other = np.array([0.1, 0.1, -0.1])
    after = mean_square(difference + other @ columns)
    assert promised(matrix, right, other) == pytest.approx(mean_square(difference) - after)


def test_noise_of_derivatives_shortens_steps_and_the_factor_makes_up_for_it() -> None:
    generator = np.random.default_rng(2)
    columns, truth = generator.normal(size=(3, 20000)), np.array([0.1, -0.05, 0.2])
    noisy = Linear(columns + 0.7 * generator.normal(size=columns.shape))
    difference = -truth @ columns
    start = Difference(np.zeros(3), difference, noisy, mean_square(difference))
    step = after_step(*start.system(), 0.0, start.x, FREE)
    assert np.linalg.norm(step) < 0.75 * np.linalg.norm(truth)
    factor = noisy.factor(step, step @ columns)
    assert 0.6 < factor < 0.75
    np.testing.assert_allclose(after_step(*noisy.times(factor).system(difference), 0.0, start.x, FREE), truth, rtol=0.05)
    assert Linear(columns).factor(step, step @ columns) == pytest.approx(1)
    assert Linear(columns).factor(step, -step @ columns) == 0.5 and Linear(columns).factor(step, 3 * step @ columns) == 1
    # The points that follow have the factor of the step before. It is measured with derivatives that have none.
    second = replace(start, x=step, values=difference + step @ columns).after(start, trusted=False)
    third = replace(start, x=truth, values=0 * difference).after(second, trusted=True)
    assert second.scale == pytest.approx(factor) and third.scale == pytest.approx(factor, abs=0.03)
    np.testing.assert_allclose(after_step(*second.system(), 0.0, step, FREE), truth, atol=0.01)


def test_models_are_the_derivatives_of_averaged_differences(problem: PoseProblem) -> None:
    reference = np.array(mi.render(problem.scene, integrator=mi.load_dict({"type": "direct"}), spp=64))
    fine, coarse = differences(problem, reference, 32, 64, 2), differences(problem, reference, 16, 256)
    point = coarse.at(NEAR)
    assert point.cost == pytest.approx(mean_square(point.values)) and point.cost == pytest.approx(coarse.loss(NEAR), rel=1e-3)
    # Averages of images are images with larger pixels.
    assert np.abs(fine.difference(NEAR) - point.values).max() < 0.05 * np.abs(point.values).max()
    for k, change in enumerate(0.01 * np.eye(3)):
        difference = (fine.difference(NEAR + change) - fine.difference(NEAR - change)) / 0.02
        slope = point.model.columns[k]
        assert slope @ difference > 0.97 * np.linalg.norm(slope) * np.linalg.norm(difference)
        assert np.linalg.norm(slope) == pytest.approx(np.linalg.norm(difference), rel=0.1)


def steps_of(differences: Differences, start: np.ndarray, limits: Limits) -> Iterator[Difference]:
    point = differences.at(start)
    yield point
    yield from minimise(differences.at, point, limits)


def test_damped_steps_go_down_and_end_where_no_step_is_worth_it(problem: PoseProblem) -> None:
    target = differences(problem, np.ones((32, 32, 3)), 16, 64).image(NEAR)
    limits = replace(FREE, steps=12, shortest=1e-4, worth=0.1, dares=0)
    points = list(steps_of(differences(problem, target, 16, 64), np.zeros(3), limits))
    losses = [point.cost for point in points]
    assert losses == sorted(losses, reverse=True) and losses[-1] < 1e-3 * losses[0] and len(losses) < 12
    np.testing.assert_allclose(points[-1].x, NEAR, atol=3e-3)


def test_fixed_numbers_stay(problem: PoseProblem) -> None:
    target = differences(problem, np.ones((32, 32, 3)), 16, 64).image(np.array([0, 0.08, -0.06]))
    start = np.array([0.1, 0, 0])
    low, high = (np.array([0.1, bound, bound]) for bound in (-np.inf, np.inf))
    points = list(steps_of(differences(problem, target, 16, 64), start, replace(FREE, low=low, high=high, shortest=1e-4)))
    assert len(points) > 1 and all(point.x[0] == start[0] for point in points)
    assert np.abs(points[-1].x[1:] - [0.08, -0.06]).max() < 0.03

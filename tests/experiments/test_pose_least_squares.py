"""Least squares of differences: linear models with and without noise, damped steps, averages over blocks."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr import Renderer
from shadowmap_dr.experiments.pose.least_squares import DampedSteps, Differences, Linear, mean_square
from shadowmap_dr.experiments.pose.scene import PoseProblem, make_problem
from shadowmap_dr.fitting.motion_parameters import ShapeMotion
from shadowmap_dr.fitting.targets import make_target
from shadowmap_dr.fitting.vary import Vary
from shadowmap_dr.fitting.views import Quality

NEAR = np.array([0.05, 0.02, -0.03])


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
    model = Linear(columns)
    step = model.step(difference)
    np.testing.assert_allclose(step, truth, rtol=1e-6)
    assert model.promise(difference, step) == pytest.approx(mean_square(difference))
    assert np.linalg.norm(model.step(difference, 1.0)) < 0.6 * np.linalg.norm(step)
    far = model.step(10 * difference)
    np.testing.assert_allclose(far, truth * 1.5, rtol=1e-6)  # the longest change is 0.3
    assert model.promise(difference, -step) < 0
    # A number that moves nothing gets no step.
    idle = Linear(np.vstack([columns, np.zeros(500)])).step(difference)
    np.testing.assert_allclose(idle, [*truth, 0], atol=1e-6)


def test_noise_of_derivatives_shortens_steps_and_the_factor_makes_up_for_it() -> None:
    generator = np.random.default_rng(2)
    columns, truth = generator.normal(size=(3, 20000)), np.array([0.1, -0.05, 0.2])
    noisy = Linear(columns + 0.7 * generator.normal(size=columns.shape))
    difference = -truth @ columns
    step = noisy.step(difference)
    assert np.linalg.norm(step) < 0.75 * np.linalg.norm(truth)
    factor = noisy.factor(step, step @ columns)
    assert 0.6 < factor < 0.75
    np.testing.assert_allclose(noisy.times(factor).step(difference), truth, rtol=0.05)
    assert Linear(columns).factor(step, step @ columns) == pytest.approx(1)
    assert Linear(columns).factor(step, -step @ columns) == 0.5 and Linear(columns).factor(step, 3 * step @ columns) == 1


def test_models_are_the_derivatives_of_averaged_differences(problem: PoseProblem) -> None:
    reference = np.array(mi.render(problem.scene, integrator=mi.load_dict({"type": "direct"}), spp=64))
    fine, coarse = differences(problem, reference, 32, 64, 2), differences(problem, reference, 16, 256)
    point = coarse.at(NEAR)
    assert point.loss == pytest.approx(mean_square(point.values)) and point.loss == pytest.approx(coarse.loss(NEAR), rel=1e-3)
    # Averages of images are images with larger pixels.
    assert np.abs(fine.difference(NEAR) - point.values).max() < 0.05 * np.abs(point.values).max()
    for k, change in enumerate(0.01 * np.eye(3)):
        difference = (fine.difference(NEAR + change) - fine.difference(NEAR - change)) / 0.02
        slope = point.model.columns[k]
        assert slope @ difference > 0.97 * np.linalg.norm(slope) * np.linalg.norm(difference)
        assert np.linalg.norm(slope) == pytest.approx(np.linalg.norm(difference), rel=0.1)


def test_damped_steps_go_down_and_end_where_no_step_is_worth_it(problem: PoseProblem) -> None:
    steps = DampedSteps(
        differences(problem, differences(problem, np.ones((32, 32, 3)), 16, 64).image(NEAR), 16, 64), np.zeros(3), 1e-4
    )
    losses = [steps.point.loss]
    while steps.advance():
        losses.append(steps.point.loss)
        assert len(losses) < 12
    assert losses == sorted(losses, reverse=True) and losses[-1] < 1e-3 * losses[0]
    np.testing.assert_allclose(steps.point.x, NEAR, atol=3e-3)
    last = steps.point
    assert not steps.advance() and steps.point is last


def test_fixed_numbers_stay(problem: PoseProblem) -> None:
    target = differences(problem, np.ones((32, 32, 3)), 16, 64).image(np.array([0, 0.08, -0.06]))
    start = np.array([0.1, 0, 0])
    steps = DampedSteps(differences(problem, target, 16, 64), start, 1e-4, fixed=(0,))
    while steps.advance():
        assert steps.point.x[0] == start[0]
    assert np.abs(steps.point.x[1:] - [0.08, -0.06]).max() < 0.03

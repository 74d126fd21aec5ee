"""Pose parametrisation and the optimisation loop."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from fakes import POINTS, BlobRenderer

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.inverse import History, PoseFit, apply_pose, optimize
from shadowmap_dr.inverse.image_blur import blurred

START = [0.3, 0.15, -0.1]


def fit(**options: Any) -> PoseFit:
    renderer = BlobRenderer.create(16, len(POINTS))
    target = np.array(renderer.render({"object": mi.Float(POINTS.ravel())}))
    return PoseFit(renderer, "object", POINTS, target, **options)


def test_pose_is_rotation_about_y_then_offset(variant: str) -> None:
    angle, x, y = 0.4, 0.2, -0.3
    moved = np.array(apply_pose(mi.Float(POINTS.ravel()), mi.Float([angle, x, y]), 5.0)).reshape(-1, 3)
    matrix = np.array(mi.ScalarTransform4f().translate([x, y, 5]).rotate([0, 1, 0], np.rad2deg(angle)).matrix)
    np.testing.assert_allclose(moved, POINTS @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-6)


def test_gradient_of_the_pose_against_central_differences(variant: str) -> None:
    weights = mi.Float(np.random.default_rng(0).normal(size=POINTS.size).astype(np.float32))

    def value(pose: Any) -> Any:
        return dr.sum(weights * apply_pose(mi.Float(POINTS.ravel()), pose))

    pose = mi.Float(START)
    dr.enable_grad(pose)
    dr.backward(value(pose))
    for i, step in enumerate(np.eye(3) * 1e-2):
        difference = (value(mi.Float(START + step)) - value(mi.Float(START - step)))[0] / 2e-2
        assert dr.grad(pose)[i] == pytest.approx(difference, rel=2e-3, abs=1e-3)


def test_fit_recovers_the_pose(variant: str) -> None:
    method = fit()
    history = optimize(method, START, 150)
    assert np.abs(history.final).max() < 2e-3
    assert history.parameters.shape == (151, 3) and history.loss.shape == (150,)
    np.testing.assert_allclose(history.parameters[0], START)
    assert history.loss[-1] < 1e-3 * history.loss[0]
    assert method.render(history.final).shape == (16, 16, 1)


def test_blurred_gradients_against_differences_of_blurred_images(variant: str) -> None:
    width, size = 2.0, 16
    method = fit(blur=width, blur_steps=10)
    method.reset(START)
    method.step()
    # Adam's first moment is a tenth of the first gradient.
    gradient = method.state()["m"] / 0.1
    target = fit().render(np.zeros(3))[..., 0].astype(np.float64)
    place = np.arange(size)
    kernel = np.exp(-0.5 * ((place[:, None] - place) / width) ** 2) / np.exp(-0.5 * (np.arange(-9, 10) / width) ** 2).sum()

    def loss(pose: Any) -> float:
        difference = method.render(pose)[..., 0] - target
        return float((difference * (kernel @ difference @ kernel.T)).mean())

    expected = [(loss(START + step) - loss(START - step)) / 2e-2 for step in np.eye(3) * 1e-2]
    np.testing.assert_allclose(gradient, expected, rtol=0.02, atol=1e-4)
    optimize(method, START, 20)
    assert method.recordings() <= 2


def test_losses_are_those_of_images_without_blur(variant: str) -> None:
    losses = [optimize(method, START, 1).loss for method in (fit(), fit(blur=3.0, blur_steps=10))]
    np.testing.assert_allclose(*losses, rtol=1e-5)


def test_after_the_blur_steps_are_as_without(variant: str) -> None:
    ends = []
    for options in ({}, {"blur": 3.0, "blur_steps": 10}):
        method = fit(**options)
        method.load_state({**method.state(), "parameters": np.array(START), "t": np.full(1, 10.0)})
        method.step()
        ends.append(np.array(method.parameters()))
    np.testing.assert_allclose(*ends, rtol=1e-5)


@pytest.mark.parametrize(("width", "most"), [(0.0, 8.0), (2.5, 8.0), (8.0, 8.0), (30.0, 32.0), (3.0, 32.0)])
def test_blur_against_a_dense_gaussian(variant: str, width: float, most: float) -> None:
    rng = np.random.default_rng(0)
    image = rng.random((90, 120, 3)).astype(np.float32)
    found = np.array(blurred(mi.Float(image.ravel()), image.shape, mi.Float(width), most)).reshape(image.shape)
    expected = image.astype(np.float64)
    for axis in (0, 1):
        place = np.arange(image.shape[axis])
        kernel = np.exp(-0.5 * ((place[:, None] - place) / max(width, 1e-3)) ** 2)
        whole = np.exp(-0.5 * (np.arange(-400, 401) / max(width, 1e-3)) ** 2).sum()
        expected = np.moveaxis(np.tensordot(kernel / whole, expected, (1, axis)), 0, axis)
    # Wide Gaussians are sampled, and lose a little more at the border.
    assert np.abs(found - expected).max() < (2e-3 if most < 16 else 0.02)


def test_step_is_recorded_at_most_twice_and_compiles_nothing_afterwards(variant: str) -> None:
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        method = fit()
        for _ in range(3):
            method.step()
        recordings = method.recordings()
        dr.kernel_history_clear()
        for _ in range(5):
            method.step()
        kernels = dr.kernel_history([dr.KernelType.JIT])
    assert method.recordings() == recordings <= 2
    assert kernels and all(kernel["cache_hit"] for kernel in kernels)


def test_frozen_steps_equal_plain_ones(variant: str) -> None:
    frozen = optimize(fit(), START, 12)
    with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
        plain = optimize(fit(), START, 12)
    np.testing.assert_allclose(frozen.parameters, plain.parameters, atol=1e-5)
    np.testing.assert_allclose(frozen.loss, plain.loss, rtol=1e-4)


def test_gradient_leaves_the_fit_alone(variant: str) -> None:
    method = fit()
    method.reset(START)
    before = method.state()
    assert np.abs(method.gradient(START)).min() > 0
    after = method.state()
    for name, value in before.items():
        np.testing.assert_array_equal(after[name], value)


class Killed(Exception):
    pass


def killed_after(count: int) -> Any:
    def on_step(done: int) -> None:
        if done == count:
            raise Killed

    return on_step


def test_killed_run_resumes_bit_for_bit(variant: str, tmp_path: Path) -> None:
    whole = optimize(fit(), START, 33)
    path = tmp_path / "run.npz"
    for limit in (7, 27):  # before the first checkpoint, and after the second one
        with pytest.raises(Killed):
            optimize(fit(), START, 33, checkpoint=path, settings={"a": 1}, on_step=killed_after(limit))
    steps: list[int] = []
    resumed = optimize(fit(), START, 33, checkpoint=path, settings={"a": 1}, on_step=steps.append)
    assert steps == list(range(21, 34))
    np.testing.assert_array_equal(resumed.parameters, whole.parameters)
    np.testing.assert_array_equal(resumed.loss, whole.loss)
    assert resumed.warm.sum() == 33 - 5 - 5  # two processes contributed steps, each with a warm-up
    again = optimize(fit(), START, 33, checkpoint=path, settings={"a": 1}, on_step=steps.append)
    assert len(steps) == 13 and again.iterations == 33


def test_foreign_and_damaged_checkpoints_are_refused(variant: str, tmp_path: Path) -> None:
    path = tmp_path / "run.npz"
    optimize(fit(), START, 1, checkpoint=path, settings={"a": 1})
    with pytest.raises(ShadowmapError, match="other settings"):
        optimize(fit(), START, 2, checkpoint=path, settings={"a": 2})
    for damaged in (b"", path.read_bytes()[:200], b"PK"):
        path.write_bytes(damaged)
        with pytest.raises(ShadowmapError, match=r"cannot read the checkpoint .*run\.npz"):
            optimize(fit(), START, 2, checkpoint=path, settings={"a": 1})


def test_checkpoints_of_other_runs_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.npz"
    optimize(Counter(), np.ones(3), 20, checkpoint=path)
    for start, steps, message in ((np.zeros(3), 30, "began elsewhere"), (np.ones(2), 30, "began"), (np.ones(3), 10, "20 steps")):
        with pytest.raises(ShadowmapError, match=message):
            optimize(Counter(), start, steps, checkpoint=path)
    arrays = dict(np.load(path))
    np.savez(path, **{name: array for name, array in arrays.items() if not name.startswith("state/")})
    with pytest.raises(ShadowmapError, match=r"run\.npz lacks 'value'"):
        optimize(Counter(), np.ones(3), 30, checkpoint=path)


class Counter:
    """A method on the host: counts down by a tenth."""

    def __init__(self) -> None:
        self.value = np.zeros(3)

    def reset(self, start: Any) -> None:
        self.value = np.array(start, float)

    def step(self) -> float:
        loss = float(self.value.sum())
        self.value = self.value - 0.1
        return loss

    def parameters(self) -> np.ndarray:
        return self.value

    def render(self, parameters: Any) -> np.ndarray:
        return np.zeros((2, 2, 3), np.float32)

    def state(self) -> dict[str, np.ndarray]:
        return {"value": self.value}

    def load_state(self, state: Mapping[str, np.ndarray]) -> None:
        self.value = state["value"]

    def describe(self) -> dict[str, Any]:
        return {}


def test_history_of_a_method_on_the_host() -> None:
    history = optimize(Counter(), [1.0, 2.0, 3.0], 12)
    np.testing.assert_allclose(history.loss[:2], [6.0, 5.7])
    np.testing.assert_allclose(history.final, [-0.2, 0.8, 1.8])
    assert list(history.warm) == [False] * 5 + [True] * 7
    assert history.seconds_per_iteration == pytest.approx(np.median(history.seconds[5:]))
    assert history.seconds_total == pytest.approx(history.seconds.sum())


def test_steps_after_the_end_of_a_method_have_no_part_in_its_time() -> None:
    parameters = np.array([0.0, 0.3, 0.4, 0.5, 0.5, 0.5, 0.5, 0.5])[:, None]
    seconds = np.array([9.0, 4.0, 2.0, 1e-7, 1e-7, 1e-7, 1e-7])
    warm = np.arange(7) > 0
    history = History(np.zeros(7), parameters, seconds, warm)
    assert history.seconds_per_iteration == 3.0
    assert History(np.zeros(7), np.zeros((8, 1)), seconds, warm).seconds_per_iteration == 1e-7  # it never moved


def test_bad_input_is_refused(variant: str) -> None:
    with pytest.raises(ShadowmapError, match="0 iterations"):
        optimize(Counter(), [0, 0, 0], 0)
    with pytest.raises(ShadowmapError, match="2 numbers"):
        fit().reset([0.0, 1.0])
    with pytest.raises(ShadowmapError, match="finite"):
        PoseFit(None, "object", POINTS, np.full((2, 2, 3), np.nan))

"""Poses by Levenberg and Marquardt's method, against path-traced references and `PoseFit`."""

from __future__ import annotations

import gc
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.pose import gauss_newton
from shadowmap_dr.experiments.pose.gauss_newton import GaussNewtonPose
from shadowmap_dr.experiments.pose.methods import build_method
from shadowmap_dr.experiments.pose.scene import PoseProblem, make_problem, pose_errors, start_pose
from shadowmap_dr.experiments.pose.search import AWAY
from shadowmap_dr.inverse import PoseFit, optimize

START = np.array([np.radians(20), 0.15, -0.1])


@pytest.fixture(scope="module", params=[False, True], ids=["seen", "shadow only"])
def problem(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> PoseProblem:
    mi.set_variant("llvm_ad_rgb")
    return make_problem("spot", 64, shadow_only=request.param, work=tmp_path_factory.mktemp("spot"))


@pytest.fixture(scope="module")
def reference(problem: PoseProblem) -> np.ndarray:
    return np.array(mi.render(problem.scene, integrator=mi.load_dict({"type": "direct"}), spp=64))


@pytest.fixture(scope="module")
def method(problem: PoseProblem, reference: np.ndarray) -> GaussNewtonPose:
    built = build_method("shadows", problem, reference, optimiser="lm")
    assert isinstance(built, GaussNewtonPose)
    return built


def test_a_pose_is_found_in_few_steps(method: GaussNewtonPose, reference: np.ndarray) -> None:
    history = optimize(method, START, 40)
    degrees, offset = pose_errors(history.final)
    assert degrees < 0.3 and offset < 0.5
    # Steps after the last one change nothing, and cost nothing.
    np.testing.assert_array_equal(history.parameters[-1], history.parameters[-5])
    assert (history.loss[-5:] == history.loss[-1]).all()
    # The loss is in the unit of Adam's, and says how much of the differences is left.
    without = np.mean(np.square(method.render(AWAY) - reference))
    assert history.loss[-1] < 0.05 * without < history.loss[0]


def test_a_start_in_another_basin_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From there a descent alone ends at a face that looks the other way."""
    problem = make_problem("suzanne", 64, normals="vertex", work=tmp_path)
    reference = np.array(mi.render(problem.scene, integrator=mi.load_dict({"type": "direct"}), spp=64))
    method = build_method("shadows", problem, reference, samples=16, optimiser="lm")
    assert isinstance(method, GaussNewtonPose)
    degrees, offset = pose_errors(optimize(method, start_pose(4, 0), 60).final)
    assert degrees < 0.2 and offset < 0.3
    monkeypatch.setattr(GaussNewtonPose, "_descend_elsewhere", lambda self, loss: iter(()))
    alone = optimize(method, start_pose(4, 0), 60)
    assert pose_errors(alone.final)[0] > 30


def test_a_start_whose_steps_promise_little_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Descents from all rotations fail, until one is taken whose offset was found with more patience."""
    problem = make_problem("dragon", 128, normals="vertex", work=tmp_path)
    reference = np.array(mi.render(problem.scene, integrator=mi.load_dict({"type": "direct"}), spp=64))
    method = build_method("shadows", problem, reference, samples=9, optimiser="lm")
    degrees, offset = pose_errors(optimize(method, start_pose(0, 150), 80).final)
    assert degrees < 0.2 and offset < 0.3
    for name, value in (("_PATIENT_WORTH", gauss_newton._WORTH), ("_PATIENT_DARES", 0)):
        monkeypatch.setattr(gauss_newton, name, value)
    assert pose_errors(optimize(method, start_pose(0, 150), 80).final)[0] > 10


def test_no_pass_is_recorded_in_a_run(problem: PoseProblem, reference: np.ndarray) -> None:
    """They are before the first one."""
    gc.collect()  # recordings end with the objects of other scenes
    method = build_method("shadows", problem, reference, optimiser="lm")
    assert isinstance(method, GaussNewtonPose)
    views = [part._view for part in (method._coarse, method._fine, method._slopes)]
    passes = [one for view in views for one in (view._image, *view._jacobians)]
    counts = [one.n_recordings for one in passes]
    for run in range(3):
        optimize(method, start_pose(0, run), 40)
    assert [one.n_recordings for one in passes] == counts


@pytest.mark.parametrize(("size", "block"), [((128, 128), 2), ((512, 512), 8), ((64, 64), 1), ((100, 100), 2), ((127, 127), 1)])
def test_fine_images_are_compared_in_blocks_that_divide_them(size: tuple[int, int], block: int) -> None:
    assert gauss_newton._block(*size) == block


def test_images_are_those_of_adams_method(problem: PoseProblem, reference: np.ndarray, method: GaussNewtonPose) -> None:
    """Both turn and shift the object alike."""
    other = build_method("shadows", problem, reference)
    assert isinstance(other, PoseFit)
    for pose in (np.zeros(3), START):
        ours, theirs = method.render(pose), other.render(pose)
        assert np.abs(ours - theirs).mean() < 0.02 * theirs.mean()


def test_a_stopped_run_goes_on_from_its_stage(method: GaussNewtonPose, tmp_path: Path) -> None:
    whole = optimize(method, START, 30)
    optimize(method, START, 20, checkpoint=tmp_path / "run.npz")
    resumed = optimize(method, START, 30, checkpoint=tmp_path / "run.npz")
    np.testing.assert_allclose(resumed.final, whole.final, atol=2e-3)
    assert method.describe()["optimizer"] == "Levenberg-Marquardt"


def test_other_numbers_and_images_are_refused(problem: PoseProblem, method: GaussNewtonPose) -> None:
    with pytest.raises(ShadowmapError, match="a pose of 2 numbers"):
        method.reset(np.zeros(2))
    with pytest.raises(ShadowmapError, match="give finite values"):
        build_method("shadows", problem, np.full((64, 64, 3), np.nan, np.float32), optimiser="lm")

"""Photographs of problems for the command `fit`."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from fit_problems import quick
from PIL import Image

from shadowmap_dr.experiments.bench.fits import catalogue, meshes, targets
from shadowmap_dr.experiments.bench.fits.photographs import Photograph, falloff
from shadowmap_dr.io.images import to_linear


@pytest.fixture(autouse=True)
def _variant() -> None:
    mi.set_variant("llvm_ad_rgb")


def test_photographs() -> None:
    random = np.random.default_rng(0)
    picture = random.uniform(0.05, 0.4, (40, 60, 3))
    plain = to_linear(Photograph(2.0).taken(picture, 0) / 255)
    np.testing.assert_allclose(plain, 2 * picture, atol=0.008)
    tinted = to_linear(Photograph(1.0, white=(1.5, 0.5)).taken(picture, 0) / 255)
    np.testing.assert_allclose(tinted.mean((0, 1)) / picture.mean((0, 1)), [1.5, 1, 0.5], rtol=0.01)
    light = falloff(30, 40, 0.5)
    assert light.max() > 0.999 and light[0, 0] == pytest.approx(np.cos(np.arctan(0.5)) ** 4, rel=0.03)
    noisy = to_linear(Photograph(1.0, noise=True).taken(np.full((80, 80, 3), 0.3), 3) / 255)
    assert 0.004 < noisy.std() < 0.01 and noisy.mean() == pytest.approx(0.3, abs=0.002)
    assert (Photograph(1.0, noise=True).taken(picture, 3) != Photograph(1.0, noise=True).taken(picture, 4)).any()


def test_the_command_gets_nothing_of_the_truth(tmp_path: Path) -> None:
    problem = quick(catalogue.named(["house-pose-sun"])[0])
    targets.write_problem(problem, 0, tmp_path / "given", tmp_path / "pictures")
    assert sorted(path.name for path in (tmp_path / "given").iterdir()) == ["house.ply", "photo.jpg", "scene.xml"]
    text = (tmp_path / "given" / "scene.xml").read_text()
    house, sun = problem.truth.body("house"), problem.truth.lamp("sun")
    for number in (*house.place[:3].ravel(), *sun.direction):
        assert f"{number:.4f}" not in text
    vertices, _ = meshes.mesh("house").vertices, None
    assert np.abs(vertices).max() == 1 and np.allclose(vertices.min(0) + vertices.max(0), 0)
    arguments = problem.options()
    assert arguments[:3] == ["scene.xml", "--target", "photo.jpg"] and "--exposure" in arguments
    photo = Image.open(tmp_path / "given" / "photo.jpg")
    assert photo.size == (32, 24) and not photo.getexif()


def test_pictures_are_rendered_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = quick(catalogue.named(["bunny-pose"])[0])
    first = targets.truth_pictures(problem, tmp_path)[0]
    monkeypatch.setattr(targets, "render", None)
    np.testing.assert_array_equal(targets.truth_pictures(problem, tmp_path)[0], first)
    with pytest.raises(TypeError):
        targets.truth_pictures(dataclasses.replace(problem, spp=5), tmp_path)


def test_masks_leave_the_intruder_and_its_shadow_out(tmp_path: Path) -> None:
    problem = quick(catalogue.named(["chair-mask"])[0])
    targets.write_problem(problem, 0, tmp_path / "given", tmp_path)
    kept = np.array(Image.open(tmp_path / "given" / "mask.png"))
    assert "--mask" in problem.options() and set(np.unique(kept)) == {0, 255} and 0.6 < (kept > 0).mean() < 0.98
    one, other = targets.truth_pictures(problem, tmp_path), targets._pictures(problem.truth, problem, tmp_path)
    changed = np.abs(one[0] - other[0]).max(-1) > 0.1 * other[0].mean()
    assert changed.any() and not (changed & (kept > 0))[1:-1, 1:-1].sum() > 2


def test_two_views_have_two_targets() -> None:
    problem = catalogue.named(["glider-views"])[0]
    assert problem.options()[1:5] == ["--target", "0=photo-0.jpg", "--target", "1=photo-1.jpg"]
    white = catalogue.named(["white-balance"])[0].options()
    assert "--white-balance" in white and "--exposure" not in white

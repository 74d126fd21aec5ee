"""Problems for the command `fit`: their tables, starts and scenes."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from fit_problems import EVERY, NAMES, record_of

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.bench.common import QUICK
from shadowmap_dr.experiments.bench.fits import catalogue, meshes, score, stages
from shadowmap_dr.experiments.bench.fits.problem import FitProblem
from shadowmap_dr.experiments.bench.fits.scenes import load_scene, write_scene


@pytest.fixture(autouse=True)
def _variant() -> None:
    mi.set_variant("llvm_ad_rgb")


PROBLEMS = pytest.mark.parametrize("problem", EVERY, ids=NAMES)


def test_the_tables() -> None:
    assert len(catalogue.scored()) == 40 and len(catalogue.calibration()) == 16
    assert len(set(NAMES)) == 56
    things = [{body.mesh for body in one.truth.bodies if not body.backdrop and body.radiance is None} for one in EVERY]
    assert not set().union(*things[:40]) & set().union(*things[40:])  # nothing is tuned on things that are scored
    assert sum(bool(found & meshes.MADE.keys()) for found in things[:40]) >= 8
    kinds = {one.kind for problem in catalogue.scored() for one in problem.varied}
    assert kinds == set("pose rotation translation scale vertices direction position fov texture value".split())
    assert sum(problem.integrator == "path" for problem in catalogue.scored()) >= 6
    photographs = [photo for problem in EVERY for photo in problem.photographs]
    assert all(0.5 <= photo.exposure <= 2 for photo in photographs)
    assert {photo.quality is None for photo in photographs} == {photo.noise for photo in photographs} == {True, False}
    for problem in EVERY:
        assert max(problem.truth.cameras[0].width, problem.truth.cameras[0].height) in range(192, 321)
    assert set(QUICK.fits or ()) <= {problem.name for problem in catalogue.scored()} and len(QUICK.fits or ()) == 6


@PROBLEMS
def test_starts_are_as_far_off_as_the_ranges_say(problem: FitProblem) -> None:
    diameter = problem.truth.diameter()
    limits = {
        "rotation": (10, 30),
        "position": (0.0099, 0.1001),
        "direction": (9.9, 30.1),
        "value": (0.05, 2),
        "angle of view": (1, 8),
        "scale": (0, 1),
    }
    for number in range(4):
        start = problem.start(number)
        for one in problem.scored:
            if one.kind not in ("texture", "vertices"):
                for found in score.deviations(problem, one, start, record_of(problem, start, start), Path()):
                    low, high = limits[found.what]
                    low = 3 if found.what == "rotation" and one.part.startswith("camera") else low
                    assert low - 1e-3 <= found.error <= high + 1e-3, (found, number)
        assert start.diameter() < 1.3 * diameter
    assert problem.start(0).parts()[0].id == problem.start(1).parts()[0].id


def test_each_start_is_another() -> None:
    problem = catalogue.named(["bunny-pose"])[0]
    places = [problem.start(number).body("bunny").place for number in (0, 1, 0)]
    np.testing.assert_array_equal(places[0], places[2])
    assert np.abs(places[0] - places[1]).max() > 0.01


def test_mitsuba_loads_all_scenes(tmp_path: Path) -> None:
    for problem in EVERY:
        scene = load_scene(write_scene(problem.start(0), tmp_path / problem.name))
        table = mi.traverse(scene)
        parts = {part.id() for part in (*scene.shapes(), *scene.emitters(), *scene.sensors())}
        assert len(scene.sensors()) == len(problem.photographs)
        for one in problem.varied:
            if one.kind == "value":
                assert one.name in table or f"{one.name}.value" in table
            elif one.kind == "texture":
                assert f"{one.part}.bsdf.{one.detail}.data" in table
            else:
                assert one.part in parts


def test_mitsuba_sees_the_places_that_the_record_has(tmp_path: Path) -> None:
    problem = next(one for one in EVERY if one.name == "camera-fov")
    scene = load_scene(write_scene(problem.truth, tmp_path))
    table = mi.traverse(scene)
    camera = problem.truth.camera("camera")
    found = np.array(mi.Matrix4f(table["camera.to_world"].matrix), float).reshape(4, 4, -1)[..., 0]
    np.testing.assert_allclose(found, camera.place, atol=1e-5)
    assert float(np.array(table["camera.x_fov"]).item()) == pytest.approx(camera.fov, rel=1e-5)
    house = next(shape for shape in scene.shapes() if shape.id() == "house")
    box = house.bbox()
    world = problem.truth.body("house").world()
    np.testing.assert_allclose([np.array(box.min).ravel(), np.array(box.max).ravel()], [world.min(0), world.max(0)], atol=1e-5)


def test_names_of_problems() -> None:
    with pytest.raises(ShadowmapError, match="bunny-pose"):
        catalogue.named(["bunny-pos"])
    assert isinstance(stages.HALF, float)

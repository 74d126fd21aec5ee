"""The score of fits: what counts as solved."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from fit_problems import SMALL, labels_of, record_of, turning

from shadowmap_dr.experiments.bench.fits import catalogue, meshes, score, space, variations
from shadowmap_dr.experiments.bench.fits.problem import FitProblem
from shadowmap_dr.experiments.bench.fits.scenes import write_scene


@pytest.fixture(autouse=True)
def _variant() -> None:
    mi.set_variant("llvm_ad_rgb")


@pytest.mark.parametrize("problem", SMALL, ids=[one.name for one in SMALL])
def test_truths_are_solved_and_starts_are_not(problem: FitProblem) -> None:
    start = problem.start(0)
    result = score.score(problem, start, record_of(problem, start, problem.truth), Path())
    assert result["solved"], result["deviations"]
    assert all(entry["value"] == pytest.approx(entry["truth"]) for entry in result["intervals"])
    for number in range(4):
        start = problem.start(number)
        assert not score.score(problem, start, record_of(problem, start, start), Path())["solved"]
        for one in problem.scored:  # each alone
            assert not all(d.is_met for d in score.deviations(problem, one, start, record_of(problem, start, start), Path()))


def test_textures_and_vertices(tmp_path: Path) -> None:
    for name, least in (("picture-on-wall", 0.05), ("hill-vertices", 0.01)):
        problem = catalogue.named([name])[0]
        start = problem.start(0)
        record = record_of(problem, start, start)
        for scene, solved in ((problem.truth, True), (start, False)):
            folder = tmp_path / name / "out"
            write_scene(scene, folder)
            result = score.score(problem, start, record, folder)
            assert result["solved"] is solved
            error = result["deviations"][0]["error"]
            assert error < 1e-3 if solved else error > least


def test_texels_that_no_picture_shows_do_not_count(tmp_path: Path) -> None:
    problem = catalogue.named(["picture-on-wall"])[0]
    seen = score.seen_texels(problem, problem.varied[0], tmp_path / "out")
    assert seen.shape == (32, 32) and 0.4 < seen.mean() < 0.95


def test_true_numbers_are_those_of_the_command() -> None:
    """Applies them as the command does: about the middle of a shape's box, about own axes of lights and cameras."""

    def turn(numbers: dict[str, float], names: tuple[str, ...]) -> Any:
        return space.moved(space.rotation(np.radians([numbers.get(name, 0.0) for name in names])))

    own, world = ("tilt", "pan", "roll"), tuple(f"rotation {axis}" for axis in "xyz")
    count = 0
    for problem in SMALL:
        start = problem.start(1)
        for part in {one.part for one in problem.scored if one.kind not in ("value", "fov")}:
            numbers: dict[str, float] = {}
            holder = start.holds(part)
            for one in problem.scored:
                if one.part == part and one.kind not in ("value", "fov"):
                    labels = labels_of(one, holder)
                    found = score.true_numbers(problem.truth, start, one, {"labels": labels, **turning(start, part)})
                    numbers |= {label: n for label, n in zip(labels, found, strict=True) if n is not None}
            old, new = (getattr(scene, holder)(part).place for scene in (start, problem.truth))
            shift = space.moved(np.eye(3), [numbers.get(f"translation {axis}", 0.0) for axis in "xyz"])
            if variations.is_round(start, part) and holder == "body":  # its direction has no numbers in the world's axes
                np.testing.assert_allclose((shift @ old)[:3, 3], new[:3, 3], atol=1e-9)
                assert not numbers.keys() & set(world)
            elif holder == "body":
                world_box = start.body(part).world()
                middle = (world_box.min(0) + world_box.max(0)) / 2
                to, back = space.moved(np.eye(3), middle), space.moved(np.eye(3), -middle)
                size = np.diag([*[numbers.get("scale", 1.0)] * 3, 1.0])
                got = shift @ to @ size @ turn(numbers, world) @ back @ old
                np.testing.assert_allclose(got, new, atol=1e-9)
            elif holder == "camera":
                np.testing.assert_allclose(shift @ old @ turn(numbers, own), new, atol=1e-9)
            elif "turn 1" in numbers:
                np.testing.assert_allclose(
                    (shift @ old)[:3, 3], new[:3, 3] if "translation x" in numbers else old[:3, 3], atol=1e-9
                )
                first, second = score.tangents(old[:3, 2])
                around = space.rotation(np.radians(numbers["turn 1"]) * first + np.radians(numbers["turn 2"]) * second)
                np.testing.assert_allclose(around @ old[:3, 2], new[:3, 2], atol=1e-9)
            else:
                np.testing.assert_allclose((shift @ old)[:3, 3], new[:3, 3], atol=1e-9)
            count += 1
    assert count > 40


def test_values_and_exposures_up_to_their_common_factor() -> None:
    problem = catalogue.named(["both-lights"])[0]
    assert problem.common_factor == ("sun.irradiance", "sky.radiance")
    start, truth = problem.start(0), problem.truth
    darker = truth
    for one in problem.varied:
        if one.kind == "value":
            darker = variations.with_value(darker, one, variations.value(truth, one) / 3)
    assert score.score(problem, start, record_of(problem, start, darker, exposure=3.0), Path())["solved"]
    assert not score.score(problem, start, record_of(problem, start, darker), Path())["solved"]
    sky = next(one for one in problem.varied if one.name == "sky.radiance")
    other = variations.with_value(darker, sky, variations.value(darker, sky) * 1.05)
    assert not score.score(problem, start, record_of(problem, start, other, exposure=3.0), Path())["solved"]
    names = {entry["name"] for entry in score.score(problem, start, record_of(problem, start, truth), Path())["intervals"]}
    assert names == {f"suzanne:pose {label}" for label in labels_of(problem.varied[0], "body")}


def test_no_common_factor_if_something_stays() -> None:
    problem = catalogue.named(["teapot-colours"])[0]
    assert not problem.common_factor
    start = problem.start(0)
    assert not score.score(problem, start, record_of(problem, start, problem.truth, exposure=1.2), Path())["intervals"] == []
    brighter = variations.with_value(problem.truth, problem.varied[0], variations.value(problem.truth, problem.varied[0]) * 1.1)
    assert not score.score(problem, start, record_of(problem, start, brighter, exposure=1 / 1.1), Path())["solved"]


def test_pictures_with_light_that_bounces_say_nothing_of_colours() -> None:
    problem = catalogue.named(["bounces-all"])[0]
    assert [one.name for one in problem.scored] == ["suzanne:pose", "sun:direction"]
    assert 0.04 <= variations.value(problem.start(0), variations.parse("sky.radiance"))[0] <= 0.12


def test_motions_against_brute_force() -> None:
    """Rotations by the largest turn of any direction, positions by the boxes of moved vertices."""
    problem = catalogue.named(["chair-pose"])[0]
    start, chair = problem.start(0), problem.truth.body("chair")
    random = np.random.default_rng(0)
    directions = random.normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for deg, length in ((0.3, 0.01), (0.7, 0.05), (8.0, 0.2), (179.0, 0.0)):
        axis = space.random_direction(random)
        turn = space.rotation(np.radians(deg) * axis)
        place = space.moved(turn, length * space.random_direction(random), chair.centre()) @ chair.place
        moved = problem.truth.replaced(dataclasses.replace(chair, place=place))
        record = record_of(problem, start, moved)
        rotation, position = score.deviations(problem, problem.varied[0], start, record, Path())
        cosines = np.einsum("nk,nk->n", directions @ turn.T, directions)
        assert rotation.error == pytest.approx(np.degrees(np.arccos(cosines.min())), rel=0.01)
        corners = chair.local()
        middle = np.append((corners.min(0) + corners.max(0)) / 2, 1)
        distance = np.linalg.norm((place @ middle - chair.place @ middle)[:3])
        every = np.concatenate([body.world() for body in problem.truth.bodies])
        assert position.error == pytest.approx(distance / np.linalg.norm(every.max(0) - every.min(0)), abs=1e-9)
        assert rotation.is_met == (deg < 0.5) and position.unit == "of the diameter"


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, 3.1, np.pi])
def test_rotation_vectors(angle: float) -> None:
    vector = angle * space.unit([0.3, -0.5, 0.8])
    np.testing.assert_allclose(space.rotation_vector(space.rotation(vector)), vector, atol=1e-7)
    np.testing.assert_allclose(space.nearest_rotation(1.7 * space.rotation(vector)), space.rotation(vector), atol=1e-12)


def test_chamfer_distance_against_brute_force() -> None:
    ball = meshes.mesh("globe")
    one, faces = ball.vertices, ball.faces.astype(int)
    assert score.chamfer((one, faces), (one, faces)) == 0
    found = score.chamfer((1.1 * one, faces), (one, faces))
    assert found == pytest.approx(0.1, rel=0.05)
    other = score.chamfer((1.1 * one, faces[::-1]), (one, faces))  # other faces: points lie apart, too
    assert found < other < 0.13
    random = np.random.default_rng(1)
    a, b = random.normal(size=(2, 50, 3))
    brute = np.linalg.norm(a[:, None] - b[None], axis=-1).min(1).mean()
    assert score._nearest(a, b) == pytest.approx(brute)


def test_missing_estimates_are_not_solved() -> None:
    problem = catalogue.named(["bunny-pose"])[0]
    start = problem.start(0)
    record = record_of(problem, start, problem.truth)
    record["estimates"] = record["estimates"][1:]
    result = score.score(problem, start, record, Path())
    assert not result["solved"] and result["deviations"][0]["what"] == "missing"


def test_summary() -> None:
    def run(problem: str, solved: bool, found: bool, error: float, half: float | None) -> dict[str, Any]:
        interval = {"name": "a", "value": 1 + error, "truth": 1.0, "half_width": half}
        return {"problem": problem, "solved": solved, "found": found, "seconds": 2.0, "intervals": [interval]}

    runs = [
        run("one", True, True, 0.1, 0.3),
        run("one", True, False, 0.1, 0.01),  # counted once
        run("two", True, True, 0.2, 0.1),
        run("three", False, True, 9.0, 0.1),  # not solved
        run("four", True, True, 0.1, None),
        {"problem": "five", "seconds": 5.0, "failed": "no", "solved": False},
    ]
    total = score.summary(runs)
    assert (total["starts"], total["solved"], total["failed"]) == (6, 4, 1)
    assert (total["false_found"], total["missed"]) == (1, 1)
    assert total["intervals"] == 3 and total["coverage"] == pytest.approx(2 / 3) and total["ratio"] == pytest.approx(3)
    assert total["seconds"] == {"median": 2, "max": 5}

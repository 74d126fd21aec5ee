"""Problems for the command `fit`: their scenes, their photographs, their score."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.bench import report as bench_report
from shadowmap_dr.experiments.bench.common import QUICK, BenchOptions, Sizes
from shadowmap_dr.experiments.bench.fits import catalogue, meshes, score, section, space, stages, targets, trial, variations
from shadowmap_dr.experiments.bench.fits.photographs import Photograph, falloff
from shadowmap_dr.experiments.bench.fits.problem import FitProblem
from shadowmap_dr.experiments.bench.fits.scenes import Scene, write_scene
from shadowmap_dr.io.images import to_linear

EVERY = (*catalogue.scored(), *catalogue.calibration())
NAMES = [problem.name for problem in EVERY]
PROBLEMS = pytest.mark.parametrize("problem", EVERY, ids=NAMES)
SMALL = [one for one in EVERY if not {v.kind for v in one.varied} & {"texture", "vertices"}]


@pytest.fixture(autouse=True)
def _variant() -> None:
    mi.set_variant("llvm_ad_rgb")


# ---------------------------------------------------------------------------------------------------------- the tables


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
        scene = mi.load_file(str(write_scene(problem.start(0), tmp_path / problem.name)))
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
    scene = mi.load_file(str(write_scene(problem.truth, tmp_path)))
    table = mi.traverse(scene)
    camera = problem.truth.camera("camera")
    found = np.array(mi.Matrix4f(table["camera.to_world"].matrix), float).reshape(4, 4, -1)[..., 0]
    np.testing.assert_allclose(found, camera.place, atol=1e-5)
    assert float(np.array(table["camera.x_fov"]).item()) == pytest.approx(camera.fov, rel=1e-5)
    house = next(shape for shape in scene.shapes() if shape.id() == "house")
    box = house.bbox()
    world = problem.truth.body("house").world()
    np.testing.assert_allclose([np.array(box.min).ravel(), np.array(box.max).ravel()], [world.min(0), world.max(0)], atol=1e-5)


# ---------------------------------------------------------------------------------------------------------- the score


def record_of(problem: FitProblem, start: Scene, at: Scene, exposure: float = 1.0, width: float = 0.1) -> dict[str, Any]:
    """A fit.json whose fit is the scene ``at``; exposures are the true ones times a factor."""
    estimates = []
    for one in problem.varied:
        holder = start.holds(one.part)
        entry: dict[str, Any] = {"name": one.name, "kind": one.kind, "labels": [], "units": []}
        numbers: list[float] = []
        if one.kind == "value":
            numbers = variations.value(at, one).tolist()
            entry |= {"value": numbers, "labels": ["red", "green", "blue"][: len(numbers)]}
        elif one.kind == "fov":
            numbers = [at.camera(one.part).fov]
            entry |= {"value": numbers, "labels": ["angle of view"]}
        elif one.kind not in ("texture", "vertices"):
            old, new = (getattr(scene, holder)(one.part).place for scene in (start, at))
            entry["matrix"] = (new @ np.linalg.inv(old)).tolist()
            if holder == "lamp":
                entry |= {"direction": new[:3, 2].tolist(), "position": new[:3, 3].tolist()}
            entry |= {"labels": labels_of(one, holder), **turning(start, one.part)}
            found = score.true_numbers(at, start, one, entry)
            numbers = [0.0 if number is None else number for number in found]
        estimates.append({**entry, "values": numbers, "half_width": [width] * len(numbers)})
    pictures = []
    for name, photo in zip(problem.targets(), problem.photographs, strict=True):
        factor = photo.exposure * exposure
        pictures.append({"name": name, "exposure": factor, "error": 0.01})
        estimates.append(
            {
                "name": f"exposure of {name}",
                "kind": "exposure",
                "labels": ["exposure"],
                "units": ["stops"],
                "values": [float(np.log2(factor))],
                "half_width": [width],
            }
        )
    return {"found": True, "words": [], "unexplained": 0.01, "estimates": estimates, "pictures": pictures}


def turning(start: Scene, part: str) -> dict[str, Any]:
    """Point and axes of rotations: the middle of a shape's box and those of the world; a light's and a camera's own."""
    holder = start.holds(part)
    if holder == "body":
        return {"pivot": start.body(part).centre().tolist(), "axes": np.eye(3).tolist()}
    place = getattr(start, holder)(part).place
    return {"pivot": place[:3, 3].tolist(), "axes": place[:3, :3].tolist()}


def labels_of(one: variations.Variation, holder: str) -> list[str]:
    """Labels that the command gives the numbers of a motion."""
    turns = ["tilt", "pan", "roll"] if holder == "camera" else [f"rotation {axis}" for axis in "xyz"]
    moves = [f"translation {axis}" for axis in (one.detail if one.kind == "translation" else "xyz")]
    if holder == "lamp" and one.kind == "pose":
        turns = ["turn 1", "turn 2"]
    return {
        "pose": [*turns, *moves],
        "rotation": [f"rotation {one.detail}"],
        "translation": moves,
        "position": moves,
        "scale": ["scale"],
        "direction": ["turn 1", "turn 2"],
    }[one.kind]


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


# ---------------------------------------------------------------------------------------------------------- photographs


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


def quick(problem: FitProblem, **changes: Any) -> FitProblem:
    """A problem with small pictures of few samples."""
    cameras = tuple(dataclasses.replace(camera, width=32, height=24) for camera in problem.truth.cameras)
    return dataclasses.replace(problem, truth=dataclasses.replace(problem.truth, cameras=cameras), spp=4, **changes)


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


# ---------------------------------------------------------------------------------------------------------- the section


def options(out: Path, **changes: Any) -> BenchOptions:
    return BenchOptions(out=out / "bench.json", only=("fits",), sizes=Sizes(fits=("bunny-pose",), fit_starts=2), **changes)


FAKE = """
import json, sys
from pathlib import Path
out = Path(sys.argv[sys.argv.index("--out") + 1])
start = int(out.parent.name.removeprefix("start-"))
if start == {failing}:
    sys.exit("Error: this went wrong.")
assert Path("scene.xml").is_file() and Path("photo.png").is_file()
out.mkdir()
(out / "fit.json").write_text(json.dumps(json.loads(Path({records!r}).read_text())[start]))
"""


@pytest.mark.parametrize("failing", [1, 5])
def test_the_section_runs_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: int) -> None:
    problem = quick(catalogue.named(["bunny-pose"])[0])
    starts = [problem.start(k) for k in range(2)]
    records = [record_of(problem, start, at) for start, at in zip(starts, (problem.truth, starts[1]), strict=True)]
    (tmp_path / "records.json").write_text(json.dumps(records))
    script = tmp_path / "fake.py"
    script.write_text(FAKE.format(failing=failing, records=str(tmp_path / "records.json")))
    monkeypatch.setattr(section, "COMMAND", (sys.executable, str(script), "fit"))
    result = section.measure(options(tmp_path), problem, {}, lambda *_: None)
    assert [one["solved"] for one in result["starts"]] == [True, False]
    assert result["seconds"]["fit"]["count"] == 2 and result["vary"] == ["bunny:pose"]
    first, second = (trial.line(one) for one in result["starts"])
    assert ", solved, called found (1.0 % unexplained); bunny:pose rotation " in first
    assert ("failed: status 1: Error: this went wrong." if failing == 1 else "NOT SOLVED, called found") in second
    if failing == 1:
        assert "this went wrong" in result["starts"][1]["failed"]
    rows = bench_report.rows({"sections": {"fits": {"units": {"bunny-pose": result}}}})
    cells = {row.what: row for row in rows}
    assert cells["fit: bunny-pose"].ratio == "1 solved"
    assert cells["fits: solved"].ours == "50 %" and cells["fits: solved"].met is False
    assert cells["fits: called found, but not solved"].ours == ("0" if failing == 1 else "1")
    assert cells["fits: intervals that hold the truth"].ours == "100 %"


def test_a_command_that_always_fails_fails_the_unit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(section, "COMMAND", (sys.executable, "-c", "import sys; sys.exit('Error: broken.')"))
    result = section.measure(options(tmp_path), quick(catalogue.named(["bunny-pose"])[0]), {}, lambda *_: None)
    assert result["failed"].endswith("Error: broken.")
    rows = bench_report.rows({"sections": {"fits": {"units": {"bunny-pose": result}}}})
    assert rows[0].ours == "failed" and rows[1].ours == "0 %"


def test_meshes_of_the_user(tmp_path: Path) -> None:
    with pytest.raises(ShadowmapError, match="no such folder"):
        options(tmp_path, meshes=tmp_path / "nothing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ShadowmapError, match="holds no meshes"):
        section.units(options(tmp_path, meshes=tmp_path / "empty"))
    folder = tmp_path / "own meshes"
    folder.mkdir()
    (folder / "my part-2.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 2 0\nv 0 0 3\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n")
    units = section.units(options(tmp_path, meshes=folder))
    assert [unit.name for unit in units] == ["bunny-pose", "mesh-my_part_2"]
    problem = catalogue.of_meshes(folder)[0]
    scene = mi.load_file(str(write_scene(problem.start(0), tmp_path / "scene")))
    assert "my_part_2" in {shape.id() for shape in scene.shapes()}


def test_names_of_problems() -> None:
    with pytest.raises(ShadowmapError, match="bunny-pose"):
        catalogue.named(["bunny-pos"])
    assert isinstance(stages.HALF, float)

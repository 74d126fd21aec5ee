"""Settings of the search for a pose: samples by the width of facets, blur, and tries from other rotations."""

from __future__ import annotations

import io
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from rich.console import Console

from shadowmap_dr.cli import main
from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.pose.experiment import PoseOptions, run_pose
from shadowmap_dr.experiments.pose.methods import searching
from shadowmap_dr.experiments.pose.record import AWAY, identity, make_record
from shadowmap_dr.experiments.pose.scene import make_problem, start_pose
from shadowmap_dr.experiments.pose.search import Search, choose, facet_widths, narrow_width, samples_for


@pytest.fixture(autouse=True)
def _variant() -> None:
    mi.set_variant("llvm_ad_rgb")


def bar_file(folder: Path, width: float) -> str:
    """A flat bar of length 2, whose two facets are ``width`` wide."""
    path = folder / "bar.obj"
    h = width / 2
    path.write_text(f"v -1 {-h} 0\nv 1 {-h} 0\nv 1 {h} 0\nv -1 {h} 0\nf 1 2 3\nf 1 3 4\n")
    return str(path)


def test_widths_are_those_of_projected_facets(tmp_path: Path) -> None:
    problem = make_problem(bar_file(tmp_path, 0.1), 128, work=tmp_path)
    params = mi.traverse(problem.scene)
    matrix = mi.perspective_projection([128, 128], [128, 128], [0, 0], params["camera.x_fov"][0], 0.01, 10000)
    place = problem.scene.sensors()[0].world_transform().inverse()
    seen = np.array(matrix @ (place @ mi.Point3f(problem.p_rest.T))).T[:, :2] * 128
    faces = np.array(problem.scene.shapes()[1].faces_buffer()).reshape(-1, 3)
    expected = []
    for a, b, c in seen[faces]:
        doubled = abs((b - a)[0] * (c - a)[1] - (b - a)[1] * (c - a)[0])
        expected.append([doubled / max(np.linalg.norm(b - a), np.linalg.norm(c - a), np.linalg.norm(c - b)), doubled / 2])
    np.testing.assert_allclose(facet_widths(problem), expected, rtol=1e-4)
    # An orthographic estimate: 128 pixels see 4.4 units at this distance.
    assert 0.5 < narrow_width(facet_widths(problem)) / (0.1 * 128 / 4.4) < 1.5


def test_widths_are_those_of_the_shadow_if_only_it_is_seen(tmp_path: Path) -> None:
    seen, hidden = (
        narrow_width(facet_widths(make_problem(bar_file(tmp_path, 0.1), 128, shadow_only=only, work=tmp_path)))
        for only in (False, True)
    )
    assert 0.5 * seen < hidden < seen  # the wall is farther away than the object


def test_samples_follow_the_narrowest_tenth_of_the_area() -> None:
    assert [samples_for([(width, 1.0)]) for width in (5.0, 2.0, 1.0, 0.6, 0.01)] == [1, 1, 4, 16, 16]
    assert samples_for([(5.0, 95.0), (0.1, 5.0)]) == 1
    assert samples_for([(5.0, 80.0), (0.1, 20.0)]) == 16
    assert samples_for([(0.0, 0.0)]) == 16  # seen from the edge


def test_files_are_searched_for_by_their_facets_and_own_objects_as_in_the_paper(tmp_path: Path) -> None:
    for width, resolution, samples in ((0.02, 128, 16), (0.05, 128, 4), (0.05, 512, 1), (0.5, 128, 1)):
        path = bar_file(tmp_path, width)
        problem = make_problem(path, resolution, work=tmp_path)
        assert choose(problem, path, None, None, None) == Search(samples, resolution / 16, 5)
        assert choose(problem, path, 9, 0.0, 2) == Search(9, 0.0, 2)
    for name in ("spot", "dragon"):
        problem = make_problem(name, 128, work=tmp_path)
        assert choose(problem, name, None, None, None) == Search()
        # The last images of the other optimiser need more samples.
        assert choose(problem, name, None, None, None, "lm") == Search(9, optimiser="lm")
        assert choose(problem, name, 1, None, None, "lm") == Search(1, optimiser="lm")
    assert choose(make_problem("spot", 512, work=tmp_path), "spot", None, None, None, "lm").samples == 1


@pytest.mark.usefixtures("no_pictures")
def test_a_thin_bar_is_found_from_afar_with_the_defaults_for_files(tmp_path: Path) -> None:
    # An L of bars a pixel wide; without blur, 1 sample: the bars miss each other.
    path = tmp_path / "ell.obj"
    boxes = [
        ((-0.8, -0.7, -0.2), (-0.75, 0.7, -0.15)),
        ((-0.8, -0.7, -0.2), (0.8, -0.65, 0.2)),
        ((0.2, -0.7, 0), (0.25, 0, 0.05)),
    ]
    lines, faces = [], []
    for k, (low, high) in enumerate(boxes):
        lines += [f"v {x} {y} {z}" for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
        quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        faces += ["f " + " ".join(str(8 * k + corner + 1) for corner in quad) for quad in quads]
    path.write_text("\n".join(lines + faces) + "\n")
    common: dict[str, Any] = {"objects": (str(path),), "resolutions": (48,), "methods": ("shadows",), "reference": "own"}
    records = run_pose(PoseOptions(**common, iterations=120, out=tmp_path / "auto"), console=Console(file=io.StringIO()))
    chosen = {"samples": 16, "blur": 3.0, "tries": 5, "optimiser": "adam", "chosen": ["samples", "blur", "tries"]}
    assert records[0]["search"] == chosen
    assert records[0]["settings"]["samples_per_pixel"] == 16 and records[0]["settings"]["blur"] == 3.0
    assert records[0]["rotation_error_deg"] < 1 and records[0]["translation_error_x100"] < 1
    assert records[0]["unexplained"] < 0.05 and records[0]["found"] == records[0]["recovered"]
    plain = run_pose(
        PoseOptions(**common, iterations=120, out=tmp_path / "plain", samples=1, blur=0.0, tries=1),
        console=Console(file=io.StringIO()),
    )
    assert plain[0]["search"]["chosen"] == [] and "samples_per_pixel" not in plain[0]["settings"]
    assert plain[0]["translation_error_x100"] > 3 and plain[0]["unexplained"] > 0.1


class TwoWells:
    """A method whose loss has two minima: the pose 0, and one at 0.8 radians that leaves half of the differences."""

    def __init__(self) -> None:
        self.pose, self.steps = np.zeros(3), 0

    def reset(self, start: Any) -> None:
        self.pose = np.array(start, np.float64)

    def step(self) -> float:
        self.steps += 1
        wrong = self.pose[0] > 0.3
        self.pose = self.pose + 0.5 * (np.array([0.8 if wrong else 0.0, 0, 0]) - self.pose)
        return 0.5 if wrong else float(np.square(self.pose).sum())

    def parameters(self) -> np.ndarray:
        return self.pose

    def render(self, parameters: Any) -> np.ndarray:
        return np.full((4, 4, 1), 0.0 if np.array_equal(parameters, AWAY) else 1.0, np.float32)

    def state(self) -> dict[str, np.ndarray]:
        return {"parameters": self.pose}

    def load_state(self, state: Mapping[str, np.ndarray]) -> None:
        self.pose = np.array(state["parameters"])

    def describe(self) -> dict[str, Any]:
        return {"tries": 5}


def test_a_run_tries_other_rotations_until_the_image_is_explained(tmp_path: Path) -> None:
    problem, method, reference = make_problem("spot", 8, work=tmp_path), TwoWells(), np.ones((4, 4, 1), np.float32)

    def make(run: int, checkpoint: Path | None = None) -> dict[str, Any]:
        wanted = identity(problem, "shadows", run, method, seed=0, iterations=30, reference="own")
        return make_record(method, reference, wanted, checkpoint, lambda *_: None)

    start = start_pose(0, 2)
    assert 0.3 < start[0] < 0.3 + np.radians(25)
    checkpoint = tmp_path / "a.checkpoint.npz"
    record = make(2, checkpoint)
    # The start, then 25 degrees to one side and the other: the third lies in the right well.
    turns = [np.degrees(entry["start"][0] - start[0]) for entry in record["tries"]]
    np.testing.assert_allclose(turns, [0, 25, -25], atol=1e-9)
    assert [round(entry["unexplained"], 3) for entry in record["tries"]] == [0.5, 0.5, 0.0]
    assert record["found"] and record["unexplained"] < 1e-6 and record["without_object"] == 1
    np.testing.assert_array_equal(record["start"], start)
    # Finished descents are not repeated.
    steps = method.steps
    assert make(2, checkpoint)["final"] == record["final"] and method.steps == steps
    # From a start in the right well there is one descent.
    assert len(make(0)["tries"]) == 1


def test_numbers_may_be_left_to_the_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert PoseOptions(samples=None, blur=None, tries=None) == PoseOptions()
    with pytest.raises(ShadowmapError, match="samples .* 1.5"):
        PoseOptions(samples=1.5)  # type: ignore[arg-type]
    for text, message in (
        ("many", "samples (--samples) is 'many': give a number, or auto."),
        ("0", "samples (--samples) is 0: give a whole number from 1 to 4096."),
    ):
        monkeypatch.setattr(sys, "argv", ["shadowmap-dr", "pose", "--samples", text, "--out", str(tmp_path)])
        with pytest.raises(SystemExit) as ended:
            main.main()
        assert ended.value.code
        assert message in capsys.readouterr().err


def test_methods_have_the_settings_of_a_search(tmp_path: Path) -> None:
    problem = make_problem("spot", 16, work=tmp_path)
    method = searching(Search(4, 2.0, 3), 90)("shadows", problem, np.zeros((16, 16, 3), np.float32))
    described = method.describe()
    assert (described["samples_per_pixel"], described["blur"], described["blur_steps"], described["tries"]) == (4, 2.0, 60, 3)
    plain = searching(Search(), 90)("shadows", problem, np.zeros((16, 16, 3), np.float32)).describe()
    assert not {"samples_per_pixel", "blur", "blur_steps", "tries"} & plain.keys()

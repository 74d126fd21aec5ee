"""The picture of the pose experiment, what is written before it is complete, and estimates of Mitsuba's seconds."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from pose_runs import build
from rich.console import Console

from mitsuba_baselines.fair_settings import fair_setting, seconds_of_step
from mitsuba_baselines.pose import ProjectiveSetting
from shadowmap_dr.experiments.pose import picture, record, run_steps
from shadowmap_dr.experiments.pose.experiment import PoseOptions, pictures_of, run_pose
from shadowmap_dr.experiments.pose.methods import METHODS, usual_normals
from shadowmap_dr.experiments.pose.run_steps import RunSteps
from shadowmap_dr.io import console as io_console
from shadowmap_dr.io import plot_style


def course(rotation: list[float | None], offset: list[float | None], seconds: list[float], **changes: Any) -> picture.Course:
    """A method whose run has these errors at its start and after each step."""
    found = {
        "recovered": True,
        "rotation_error_deg": rotation[-1],
        "translation_error_x100": offset[-1],
        "start": [0.5, 0.1, 0.0],
    }
    curves = {"rotation_error_curve": rotation, "translation_error_curve": offset, "seconds_curve": seconds}
    times = {"iterations": len(seconds), "seconds_total": seconds[-1], "seconds_per_iteration": 1.0, "reference": "mitsuba"}
    image = np.full((4, 6, 3), 0.2, np.float32)
    return picture.Course(image, image, [{**found, **curves, **times, **changes}])


@pytest.fixture
def text_of(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., str]:
    """The picture as a text, in which words can be looked for."""
    monkeypatch.setitem(plot_style._STYLE, "svg.fonttype", "none")

    def text(courses: dict[str, picture.Course], notes: tuple[str, ...] = ()) -> str:
        path = tmp_path / "a.svg"
        picture.draw(path, "Where it is", np.full((4, 6, 3), 0.5, np.float32), courses, notes)
        return path.read_text()

    return text


def test_the_picture_tells_errors_seconds_and_settings(text_of: Callable[..., str]) -> None:
    failed: dict[str, Any] = {"rotation_error_deg": None, "translation_error_x100": None, "recovered": False}
    courses = {
        "shadows": course([28, 1, 0.1, 0.01], [10, 1, 0.2, 0.04], [2.0, 2.1, 2.25]),
        "rasterizer": course([28, None], [10, None], [1.0], **failed),
        "mitsuba": course([28, 20, 8, 2.5], [10, 9, 8, 7], [3.0, 40.0, 81.0], recovered=False),
    }
    text = text_of(courses, ("Mitsuba: 1/1/64",))
    for words in (
        "Where it is",
        "6 x 4 pixels",
        "28.6° and 0.10 units off",
        "found: 0.010°, 0.0004 units off",
        "Mitsuba: 1/1/64",
    ):
        assert words in text, words
    assert "3 steps: 2.2 s (the first 2.0 s)" in text and "not found: 2.5°, 0.070 units off" in text and "failed" in text
    assert text.count("2.1 s</text>") == 2  # beside the dots of the run that is at the pose from its second step on
    assert all(colour.lower() in text for colour in picture.COLOURS.values())


def test_pictures_of_repeated_runs_and_of_records_of_earlier_versions(text_of: Callable[..., str]) -> None:
    twice = course([28, 0.1], [10, 0.1], [1.0])
    del twice.records[0]["seconds_curve"]
    twice.records *= 2
    assert "found 2 of 2; here 0.10° off" in text_of({"rasterizer": twice})


def test_time_from_which_a_run_stays_at_the_pose() -> None:
    times = np.array([0.0, 1.0, 2.0, 3.0])
    errors = {"rotation_error_curve": [9, 0.1, 0.3, 0.1], "translation_error_curve": [9, 0.1, 0.1, 0.2]}
    assert record.seconds_to_stay(errors, times) == (3.0, 3)
    assert record.seconds_to_stay({**errors, "translation_error_curve": [9, 9, 9, 0.4]}, times) is None
    assert record.seconds_to_stay({**errors, "rotation_error_curve": [9, 9, 9, None]}, times) is None


class FakeMitsuba:
    """A method with sample counts that remembers what was there when it began."""

    setting = ProjectiveSetting(1, 1, 64)

    def __init__(self, method: Any, written: io.StringIO, picture: Path) -> None:
        self._method, self._written, self._picture, self.before = method, written, picture, ""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._method, name)

    def step(self) -> Any:
        if not self.before:
            assert self._picture.is_file()
            self.before = self._written.getvalue()
        return self._method.step()


@pytest.mark.usefixtures("no_pictures")
def test_there_is_something_to_look_at_before_mitsubas_method_begins(tmp_path: Path) -> None:
    mi.set_variant("llvm_ad_rgb")
    options = PoseOptions(resolutions=(128,), methods=METHODS, iterations=2, reference="own", out=tmp_path)
    written, made = io.StringIO(), []

    def build_all(name: str, *arguments: Any) -> Any:
        method = build(name, *arguments)
        if name == "mitsuba":
            made.append(FakeMitsuba(method, written, pictures_of(options)[0]))
            return made[0]
        return method

    run_pose(options, build=build_all, console=Console(file=written, width=80))
    folder = tmp_path / "spot-128-vertex-normals"
    lines = [line for line in made[0].before.splitlines() if "first step" not in line]
    assert lines[0] == f"spot-128-vertex-normals reference: {folder / 'reference.png'}"
    start = folder / "shadows-run0-start.png"
    assert lines[1] == f"spot-128-vertex-normals start, 27.5 degrees and 0.13 units off: {start}" and start.is_file()
    assert [line.split(":")[0].split()[1] for line in lines[2:4]] == ["shadows", "rasterizer"]
    assert lines[4] == f"spot-128-vertex-normals picture so far: {folder / 'pose.png'}"
    time = "2 steps take about 1 s, if one takes 0.54 s, as when"
    assert "1/1/64" in lines[5] and f"a search found three of three starts; {time}" in lines[5]


def test_seconds_of_a_step_are_those_of_the_search() -> None:
    assert seconds_of_step(fair_setting(128, "vertex"), 128, "vertex") == (pytest.approx(0.538, abs=0.001), 2)
    # None of another shading or size, nor of runs that were not made.
    assert seconds_of_step(fair_setting(128, "vertex"), 128) is None
    assert seconds_of_step(ProjectiveSetting(4, 4, 64, "grid"), 128) is None


def test_long_runs_are_estimated_from_their_first_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    clock = [0.0]
    monkeypatch.setattr(run_steps.time, "monotonic", lambda: clock[0])
    with io_console.progress(Console(file=io.StringIO())) as progress:

        def run(first: float, step: float, begin: int = 1) -> list[str]:
            said.clear()
            shown = RunSteps(progress, progress.add_task("a", total=100, note=""), "a", 100, said.append)
            for done in range(begin, 101):
                clock[0] += first if done == begin else step
                shown(0, done)
            return list(said)

        first = "a: first step done, with its kernels compiled, after 4.0 s"
        assert run(4, 0.5) == [first, "a: 0.50 s a step here, by the last 3: about 48 s for the other 96"]
        assert run(4, 0.01) == [first] and run(0.5, 0.01) == []
        assert run(0.5, 2, begin=41) == ["a: 2.00 s a step here, by the last 3: about 112 s for the other 56"]


def test_meshes_of_this_package_are_smooth_and_files_flat(tmp_path: Path) -> None:
    assert usual_normals("spot") == "vertex" and usual_normals("spot.ply") == "face"
    both = PoseOptions(objects=("bunny", "cup.obj"), out=tmp_path)
    assert [path.parent.name for path in pictures_of(both)] == ["bunny-128-vertex-normals", "cup-128"]
    flat = PoseOptions(objects=("bunny", "cup.obj"), normals="face", out=tmp_path)
    assert [path.parent.name for path in pictures_of(flat)] == ["bunny-128", "cup-128"]

"""Reasons for poses that are not found, in records and on the terminal."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from pose_runs import build
from rich.console import Console

from shadowmap_dr.experiments.pose.advice import reasons
from shadowmap_dr.experiments.pose.experiment import PoseOptions, run_pose
from shadowmap_dr.experiments.pose.scene import PoseProblem, make_problem


@pytest.fixture(scope="module")
def problem(tmp_path_factory: pytest.TempPathFactory) -> PoseProblem:
    mi.set_variant("llvm_ad_rgb")
    return make_problem("spot", 128, work=tmp_path_factory.mktemp("spot"))


def unfound(**changes: Any) -> dict[str, Any]:
    """A record of a run that ended elsewhere with a loss that stays the same."""
    record = {
        "recovered": False, "method": "shadows", "shadow_only": False, "final": [0.6, 0.1, 0.0], "rotation_error_deg": 34.0,
        "iterations": 100, "loss_curve": [0.01] * 100, "unexplained": 0.6, "without_object": 0.02, "tries": [{}],
        "settings": {"samples_per_pixel": 16},
    }  # fmt: skip
    return {**record, **changes}


@pytest.mark.parametrize(
    ("changes", "words", "remedy"),
    [
        ({}, "60 % as much as without the object", "--tries 5"),
        ({"tries": [{}, {}]}, "60 %", "more --tries"),
        ({"settings": {}}, "facets below 0.44 pixels", "--samples 4"),
        ({"settings": {"samples_per_pixel": 4}}, "facets below", "--samples 16"),
        ({"final": [0.6, 3.0, 0.0]}, "left the view", "--samples"),
        ({"without_object": 1e-9}, "neither the object nor its shadow is in view", "nothing in the image"),
        ({"unexplained": 0.01}, "another pose gives nearly the same image", "symmetric"),
        ({"unexplained": 0.01, "final": [0.004, 0.0, 0.0]}, "nearly found", "--resolution"),
        ({"loss_curve": list(np.linspace(1, 0, 100))}, "still falling", "--iterations 200"),
        ({"method": "rasterizer"}, "no shadows", "--method shadows"),
        ({"method": "rasterizer", "shadow_only": True}, "out of view", "--method shadows"),
        ({"method": "mitsuba", "settings": {"fair": False}}, "sample counts", "docs/pose.md"),
        ({"final": [None, None, None]}, "not finite", "report"),
    ],
)
def test_reasons_and_remedies(problem: PoseProblem, changes: dict[str, Any], words: str, remedy: str) -> None:
    text = "; ".join(reasons(unfound(**changes), problem))
    assert words in text and remedy in text and "\n" not in text


def test_found_poses_need_no_reason(problem: PoseProblem) -> None:
    assert reasons(unfound(recovered=True), problem) == []


def test_records_of_earlier_versions_have_reasons_too(problem: PoseProblem) -> None:
    older = {name: value for name, value in unfound().items() if name not in ("unexplained", "without_object", "tries")}
    assert "another pose" in "; ".join(reasons(older, problem))


@pytest.mark.usefixtures("no_pictures")
def test_the_terminal_says_what_was_not_found_and_why(tmp_path: Path) -> None:
    mi.set_variant("llvm_ad_rgb")
    written = io.StringIO()
    options = PoseOptions(resolutions=(12,), methods=("shadows",), iterations=20, reference="own", out=tmp_path)
    (record,) = run_pose(options, build=build, console=Console(file=written, width=60))
    assert not record["found"] and record["reasons"]
    (line,) = [line for line in written.getvalue().splitlines() if "run 0: rotation" in line]
    assert line.endswith(f"not found: {'; '.join(record['reasons'])}") and "--" in line
    longer = PoseOptions(resolutions=(12,), methods=("shadows",), iterations=300, reference="own", out=tmp_path / "b")
    (record,) = run_pose(longer, build=build, console=Console(file=written, width=60))
    assert record["found"] and record["reasons"] == [] and written.getvalue().count("not found") == 1

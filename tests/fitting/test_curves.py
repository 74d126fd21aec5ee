"""Curves of the error of all starts."""

from __future__ import annotations

from pathlib import Path

import pytest
from fit_results import history

from shadowmap_dr.fitting.curves import best_start, curves_svg, draw_curves
from shadowmap_dr.fitting.result import Step


def test_the_best_start_is_that_of_the_last_stage() -> None:
    steps = history()
    assert best_start(steps) == 0
    left: list[Step] = [step for step in steps if step["start"] or step["stage"] == "16 px"]
    assert best_start(left) == 1  # the first was given up before the fine images
    assert best_start([]) is None
    assert best_start([{**steps[0], "error": float("nan")}]) is None  # type: ignore[typeddict-item]  # a Step


@pytest.mark.parametrize("dark", [False, True])
def test_plots_for_light_and_dark_pages(dark: bool) -> None:
    text = curves_svg(history(), dark=dark)
    assert text.rstrip().endswith("</svg>") and ("#56b4e9" in text) == dark
    assert ("#ffffff" in text) == (not dark)  # the background of dark pages shows through


@pytest.mark.parametrize("error", [0.0, float("nan"), float("inf"), 1e-30])
def test_errors_that_have_no_place_on_an_axis(tmp_path: Path, error: float) -> None:
    steps = history(1, 2)
    for step in steps:
        step["error"] = error
    draw_curves(tmp_path / "a.png", steps)
    draw_curves(tmp_path / "b.png", steps[:1])
    draw_curves(tmp_path / "c.png", [])
    assert (tmp_path / "c.png").stat().st_size
    for step in steps:
        step["seconds"] = float("nan")
    draw_curves(tmp_path / "d.png", steps)


def test_long_histories_stay_small() -> None:
    assert len(curves_svg(history(16, 5000))) < 400_000

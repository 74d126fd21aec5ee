"""Plots and sheets: one style, differences as numbers with a colour bar, labels at the ends of lines."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image

from shadowmap_dr.io import plot_style, plots

PACKAGE = Path(plots.__file__).resolve().parents[1]
RNG = np.random.default_rng(0)


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Figure]]:
    """Figures that were written."""
    written: list[Figure] = []
    save = Figure.savefig

    def savefig(figure: Figure, *arguments: Any, **options: Any) -> None:
        written.append(figure)
        save(figure, *arguments, **{**options, "dpi": 40})

    monkeypatch.setattr(Figure, "savefig", savefig)
    yield written


def images(*titles: str, scale: float = 1.0) -> dict[str, Any]:
    return {title: (scale * RNG.random((6, 8, 3))).astype(np.float32) for title in titles}


def test_colours_differ_for_colour_blind_people() -> None:
    """In Machado, Oliveira and Fernandes' model of deuteranopia (2009), and in lightness."""
    matrix = np.array([[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]])
    seen = [matrix @ np.array(to_rgb(colour)) for colour in plot_style.COLOURS]
    distances = [np.linalg.norm(a - b) for k, a in enumerate(seen) for b in seen[:k]]
    assert min(distances) > 0.12 and len(set(plot_style.COLOURS)) == 7
    assert plot_style.colour(7) == plot_style.colour(0) and plot_style.dash(7) != plot_style.dash(0)


def test_differences_are_numbers_with_a_bar(tmp_path: Path, figures: list[Figure]) -> None:
    rows = {"a": images("target", "result") | images("difference", scale=0.01), "b": images("target", "result", "difference")}
    plots.image_sheet(tmp_path / "sheet.png", rows)
    *pictures, bar = figures[0].axes
    assert bar.get_ylabel() == "absolute difference"
    limits = [axes.images[0].get_clim() for axes in (pictures[2], pictures[5])]
    assert limits[0] == limits[1] and limits[0][0] == 0 and 0.5 < limits[0][1] < 1
    np.testing.assert_allclose(pictures[2].images[0].get_array(), rows["a"]["difference"].mean(2))
    plots.image_sheet(tmp_path / "plain.png", {"a": images("target", "result")})
    assert len(figures[1].axes) == 2  # no bar
    plots.image_sheet(tmp_path / "most.png", rows, most=0.1)
    assert figures[2].axes[2].images[0].get_clim() == (0, 0.1)


def test_signed_differences_have_a_scale_about_zero(tmp_path: Path, figures: list[Figure]) -> None:
    plots.image_sheet(tmp_path / "a.png", {"a": {"difference": RNG.normal(size=(6, 8, 3)).astype(np.float32)}})
    low, high = figures[0].axes[0].images[0].get_clim()
    assert low == -high and figures[0].axes[1].get_ylabel() == "difference"
    plots.signed_sheet(
        tmp_path / "b.png", {k: {"x": s * RNG.normal(size=(6, 8))} for k, s in (("a", 1.0), ("b", 9.0))}, label="slope"
    )
    assert [axes.get_ylabel() for axes in figures[1].axes if axes.get_ylabel() == "slope"] == ["slope"] * 2  # a bar for each row
    plots.signed_sheet(
        tmp_path / "c.png", {k: {"x": RNG.normal(size=(6, 8))} for k in "ab"}, label={"a": "per metre", "b": "per radian"}
    )
    assert {axes.get_ylabel() for axes in figures[2].axes} >= {"per metre", "per radian"}


def test_captions_take_lines(tmp_path: Path, figures: list[Figure]) -> None:
    for width, lines in ((10.0, 1), (3.0, 3)):
        with plot_style.drawn(tmp_path / "a.png", width, 2.0) as figure:
            plot_style.caption(
                figure, "Lines: medians of the runs. Bands: from the lower to the upper quartile. Dotted: the limit."
            )
        assert figure._supxlabel.get_text().count("\n") == lines - 1


def test_lines_have_labels_and_axes_plain_numbers(tmp_path: Path, figures: list[Figure]) -> None:
    curves = {"ours": [[1.0, 0.1, 0.01]], "theirs": [[2.0, None, 0.011]], "failed": [[None, None, None]]}
    plots.plot_curves(tmp_path / "a.png", {"error [degrees]": curves})  # type: ignore[dict-item]
    (axes,) = figures[0].axes
    labels = {text.get_text(): text for text in axes.texts}
    assert labels.keys() == curves.keys() and axes.get_legend() is None and axes.get_ylabel() == "error [degrees]"
    heights = sorted(text.get_position()[1] for text in axes.texts)
    assert min(np.diff(heights)) > 0.02
    assert labels["ours"].get_color() == plot_style.COLOURS[0]
    shown = [label.get_text() for label in axes.get_yticklabels()]
    assert "0.1" in shown and not any("10^" in text for text in shown)
    assert Image.open(tmp_path / "a.png").size[0] > 0


def test_labels_stay_apart_and_below_the_top() -> None:
    places = plot_style._apart([0.1, 0.1, 0.11, 0.9, 1.0, 1.0], 0.05, 1.0)
    assert places == sorted(places) and max(places) == 1.0 and min(np.diff(places)) > 0.05 - 1e-9
    assert plot_style._apart([0.2, 0.5], 0.05, 1.0) == [0.2, 0.5]


def test_all_plots_have_this_style() -> None:
    """No module makes figures, or names colours, of its own."""
    for path in PACKAGE.rglob("*.py"):
        if path.name == "plot_style.py":
            continue
        text = path.read_text()
        imported = {node.module for node in ast.walk(ast.parse(text)) if isinstance(node, ast.ImportFrom)}
        assert "matplotlib.figure" not in imported and "C0" not in text and 'f"C{' not in text, path

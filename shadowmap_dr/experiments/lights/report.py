"""Report of light estimation: a table, a plot, and pictures of some runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table

from ...io import console, plots
from ...io.files import atomic
from .problem import LightProblem

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def table(summaries: Sequence[dict[str, Any]]) -> Table:
    """Table with a row for each setting."""
    rows = [
        [
            str(entry["lights"]),
            label_of(entry),
            str(len(entry["objects"]) * entry["runs"]),
            f"{entry['alignment_mean']:.5f}",
            f"{entry['alignment_std']:.5f}",
            f"{entry['alignment_least']:.3f}",
            f"{100 * entry['share_from_0.995']:.1f}",
        ]
        for entry in summaries
    ]
    columns = ["lights", "shadows", "runs", "alignment", "deviation", "least", "% >= 0.995"]
    return console.table("Alignment of estimated with true light directions", columns, rows)


def label_of(entry: dict[str, Any]) -> str:
    """Shadows, targets and strategy of a setting in a few words."""
    size = entry["filter_size"]
    parts = ["none" if size == 0 else "unfiltered" if size == 1 else f"{entry['filter']} {size}"]
    parts += [f"{entry['cone_deg']:g} deg"] if entry["cone_deg"] != 60 else []
    parts += ["coarse first"] if entry["strategy"] == "coarse" else []
    parts += [f"best of {entry['starts']}"] if entry["starts"] > 1 else []
    parts += ["path-traced targets"] if entry["reference"] == "mitsuba" else []
    return ", ".join(parts)


def plot(path: Path, summaries: Sequence[dict[str, Any]]) -> None:
    """Plot the alignment over iterations for each number of lights, and the final alignment over the filter size.

    Bands and bars are standard deviations. With more than three curves in a panel, only the first has a band.
    """
    from matplotlib.figure import Figure

    numbers = sorted({entry["lights"] for entry in summaries})
    columns = min(3, len(numbers) + 1)
    rows = -(-(len(numbers) + 1) // columns)
    figure = Figure(figsize=(5 * columns, 3.8 * rows), layout="constrained")
    panels = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axes, lights in zip(panels, numbers, strict=False):
        own = sorted((entry for entry in summaries if entry["lights"] == lights), key=lambda entry: entry["filter_size"])
        for k, entry in enumerate(own):
            x, mean, std = (np.array(entry[key]) for key in ("curve_iterations", "curve_mean", "curve_std"))
            axes.plot(x, mean, color=f"C{k % 10}", label=label_of(entry))
            if len(own) <= 3 or k == 0:
                axes.fill_between(x, mean - std, np.minimum(mean + std, 1), color=f"C{k % 10}", alpha=0.12, linewidth=0)
        axes.set(title=f"n = {lights}", xlabel="iteration", ylabel="alignment")
        axes.legend(fontsize=7, loc="lower right")
    _plot_sizes(panels[len(numbers)], [entry for entry in summaries if _is_plain(entry)])
    for axes in panels[len(numbers) + 1 :]:
        axes.set_axis_off()
    for axes in panels[: len(numbers) + 1]:
        axes.grid(True, alpha=0.3)
    with atomic(path) as temporary:
        figure.savefig(temporary, dpi=100)


def _plot_sizes(axes: Axes, summaries: Sequence[dict[str, Any]]) -> None:
    """Plot the final alignment over the filter size, a line for each number of lights and type of filter."""
    series: dict[tuple[int, str], list[dict[str, Any]]] = {}
    for entry in sorted(summaries, key=lambda entry: (entry["lights"], entry["filter_size"])):
        series.setdefault((entry["lights"], entry["filter"]), []).append(entry)
    for k, ((lights, filter), own) in enumerate(series.items()):
        mean, std = (np.array([entry[f"alignment_{key}"] for entry in own]) for key in ("mean", "std"))
        positions = np.array([entry["filter_size"] for entry in own]) + 0.15 * k  # side by side
        label = f"n = {lights}" + ("" if filter == "gaussian" else f", {filter}")
        bars = [std, np.minimum(std, 1 - mean)]
        axes.errorbar(positions, mean, yerr=bars, marker="o", ms=4, capsize=2, color=f"C{k}", label=label)
    axes.set(xlabel="texels of the filter (0: no shadows, 1: no filter)", ylabel="alignment at the end")
    axes.ticklabel_format(axis="y", useOffset=False)
    if series:
        axes.legend(fontsize=7, loc="lower right")


def pictures(path: Path, problems: Sequence[LightProblem], records: Sequence[Sequence[dict[str, Any]]]) -> None:
    """Write a sheet of the first run of each object: target, start, result, and their difference from the target."""
    rows = {}
    for problem, own in zip(problems, records, strict=True):
        batch, record = problem.build(), own[0]
        target = problem.target_images(batch, np.array([record["target"]]), [record["run"]])[0]
        start, final = batch.render([record["start"]])[0], batch.render([record["final"]])[0]
        rows[problem.object] = {"target": target, "start": start, "result": final, "difference": np.abs(final - target)}
    plots.image_sheet(path, rows)


def _is_plain(entry: dict[str, Any]) -> bool:
    """True for the settings of the plot over filter sizes."""
    return entry["strategy"] == "plain" and entry["starts"] == 1 and entry["reference"] == "own" and entry["cone_deg"] == 60

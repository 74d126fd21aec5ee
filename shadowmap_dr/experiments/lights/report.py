"""Report of light estimation: a table, a plot, and pictures of some runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from rich.table import Table

from ...io import console, plot_style, plots
from .problem import LightProblem

if TYPE_CHECKING:
    from matplotlib.axes import Axes


# Least angle of plots, degrees: alignments are rounded to about its cosine.
_LEAST_DEG = 0.02


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
    return console.table("Alignment of estimated with true light directions", columns, rows, wrapped=(0, 1))


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
    """Plot the angle over iterations for each number of lights, and the final angle over the filter size.

    Angles are those of the mean alignment and of a standard deviation to both sides of it. With more than three curves in a
    panel, only the first has a band.
    """
    numbers = sorted({entry["lights"] for entry in summaries})
    columns = min(3, len(numbers) + 1)
    rows = -(-(len(numbers) + 1) // columns)
    with plot_style.drawn(path, 5.2 * columns, 3.6 * rows, dpi=110) as figure:
        panels = list(figure.subplots(rows, columns, squeeze=False).flat)
        for axes, lights in zip(panels, numbers, strict=False):
            own = sorted((entry for entry in summaries if entry["lights"] == lights), key=lambda entry: entry["filter_size"])
            ends = []
            for k, entry in enumerate(own):
                x, mean, std = (np.array(entry[key]) for key in ("curve_iterations", "curve_mean", "curve_std"))
                low, middle, high = _angles(mean, std)
                axes.plot(x, middle, color=plot_style.colour(k), linestyle=plot_style.dash(k))
                dashed = " (dashed)" * (plot_style.dash(k) != plot_style.dash(0))
                ends.append((float(middle[-1]), _short(entry) + dashed, plot_style.colour(k)))
                if len(own) <= 3 or k == 0:
                    axes.fill_between(x, low, high, color=plot_style.colour(k), alpha=0.15, linewidth=0)
            axes.set(title=f"{lights} light{'s' * (lights > 1)}", xlabel="iteration", ylabel="angle to the true light [degrees]")
            _scaled(axes, [np.array(entry["curve_mean"]) for entry in own])
            plot_style.label_ends(axes, ends)
        _plot_sizes(panels[len(numbers)], [entry for entry in summaries if _is_plain(entry)])
        for axes in panels[len(numbers) + 1 :]:
            axes.set_axis_off()
        plot_style.caption(
            figure,
            "Lines and marks: angle of the mean alignment of the runs. Bands and bars: one standard deviation on each side.",
        )


def _plot_sizes(axes: Axes, summaries: Sequence[dict[str, Any]]) -> None:
    """Plot the final angle over the filter size, a line for each number of lights and type of filter."""
    series: dict[tuple[int, str], list[dict[str, Any]]] = {}
    for entry in sorted(summaries, key=lambda entry: (entry["lights"], entry["filter_size"])):
        series.setdefault((entry["lights"], entry["filter"]), []).append(entry)
    ends, sizes = [], sorted({entry["filter_size"] for entry in summaries})
    for k, ((lights, filter), own) in enumerate(series.items()):
        low, middle, high = _angles(*(np.array([entry[f"alignment_{key}"] for entry in own]) for key in ("mean", "std")))
        positions = np.array([sizes.index(entry["filter_size"]) for entry in own]) + 0.06 * k  # side by side
        tint = plot_style.colour(k)
        bars = [middle - low, high - middle] if len(series) <= 2 else None
        axes.errorbar(positions, middle, yerr=bars, marker=plot_style.marker(k), capsize=2, color=tint)
        label = f"{lights} light{'s' * (lights > 1)}" + ("" if filter == "gaussian" else f", {filter}")
        ends.append((float(middle[-1]), label, tint))
    axes.set(xlabel="texels of the filter", ylabel="angle at the end [degrees]", title="all filters")
    axes.set_xticks(range(len(sizes)), [{0: "no\nshadows", 1: "1\n(none)"}.get(size, str(size)) for size in sizes])
    _scaled(axes, [np.array([entry["alignment_mean"] for entry in summaries])])
    plot_style.label_ends(axes, ends)


def _short(entry: dict[str, Any]) -> str:
    """Label of a line."""
    text = label_of(entry)
    return "no shadows" if text == "none" else text.replace("path-traced targets", "path-traced")


def _scaled(axes: Axes, alignments: Sequence[npt.NDArray[np.float64]]) -> None:
    """Scale the vertical axis to lines of alignments: bands reach to angles of zero, which no logarithm has."""
    axes.set_yscale("log")
    drawn = [_angles(values, np.zeros_like(values))[1] for values in alignments if values.size]
    if drawn:
        axes.set_ylim(min(float(values.min()) for values in drawn) / 2, 2 * max(float(values.max()) for values in drawn))


def _angles(mean: npt.NDArray[np.float64], std: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.float64], ...]:
    """Angles (degrees) of an alignment, one standard deviation better, as it is, and one worse. None is below `_LEAST_DEG`."""
    better, worse = np.minimum(mean + std, 1), np.maximum(mean - std, -1)
    return tuple(np.maximum(np.degrees(np.arccos(np.clip(value, -1, 1))), _LEAST_DEG) for value in (better, mean, worse))


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

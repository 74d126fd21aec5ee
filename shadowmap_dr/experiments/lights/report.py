"""What light estimation leaves behind: a table, a plot like the paper's, pictures of some runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from ... import report
from ...io import atomic
from .problem import LightProblem


def table(summaries: Sequence[dict[str, Any]]) -> Table:
    """A row for each setting."""
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
    return report.table("Alignment of estimated with true light directions", columns, rows)


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
    """Alignment over iterations, and at the end over the size of the filter; bands and bars are standard deviations."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    for k, entry in enumerate(summaries):
        x, mean, std = (np.array(entry[key]) for key in ("curve_iterations", "curve_mean", "curve_std"))
        left.plot(x, mean, color=f"C{k % 10}", ls="-" if k < 10 else "--", label=f"n = {entry['lights']}, {label_of(entry)}")
        left.fill_between(x, mean - std, np.minimum(mean + std, 1), color=f"C{k % 10}", alpha=0.12, linewidth=0)
    left.set_xlabel("iteration")
    left.set_ylabel("alignment")
    left.legend(fontsize=6)
    for k, lights in enumerate(sorted({entry["lights"] for entry in summaries})):
        own = [entry for entry in summaries if entry["lights"] == lights and _is_plain(entry)]
        own.sort(key=lambda entry: entry["filter_size"])
        sizes = [entry["filter_size"] for entry in own]
        mean, std = (np.array([entry[f"alignment_{key}"] for entry in own]) for key in ("mean", "std"))
        if own:
            positions = np.array(sizes) + 0.15 * k  # side by side
            below, above = std, np.minimum(std, 1 - mean)
            right.errorbar(positions, mean, yerr=[below, above], marker="o", capsize=3, color=f"C{k}", label=f"n = {lights}")
    right.set_xlabel("texels of the filter (0: no shadows, 1: no filter)")
    right.set_ylabel("alignment at the end")
    right.ticklabel_format(axis="y", useOffset=False)
    if right.has_data():
        right.legend()
    for axes in (left, right):
        axes.grid(True, alpha=0.3)
    with atomic(path) as temporary:
        figure.savefig(temporary, dpi=130)


def pictures(path: Path, problems: Sequence[LightProblem], records: Sequence[Sequence[dict[str, Any]]]) -> None:
    """Sheet of images of the first run of each object: target, start, result, and how far the result is from the target."""
    rows = {}
    for problem, own in zip(problems, records, strict=True):
        batch, record = problem.build(), own[0]
        target = problem.target_images(batch, np.array([record["target"]]), [record["run"]])[0]
        start, final = batch.render([record["start"]])[0], batch.render([record["final"]])[0]
        rows[problem.object] = {"target": target, "start": start, "result": final, "difference": np.abs(final - target)}
    report.image_sheet(path, rows)


def _is_plain(entry: dict[str, Any]) -> bool:
    return entry["strategy"] == "plain" and entry["starts"] == 1 and entry["reference"] == "own" and entry["cone_deg"] == 60

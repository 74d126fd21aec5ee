"""Report of the experiment on faces: tables, a plot, and the expressions that a shadow determines."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from ...inverse.faces.morphable import MorphableModel
from ...io import console, plots
from ...io.console import markdown
from ...io.files import atomic
from .information import SEEN

#: Mean errors over the four heads of the paper's Table 2, (mean distance, Hausdorff distance, seconds per iteration).
PAPER = {1: (0.013, 0.105, 0.047), 3: (0.008, 0.068, 0.068)}
_TITLES = {"identity": "Identity", "both": "Identity and expression", "expression": "Expression of a known head"}


def digest(model: MorphableModel) -> str:
    """Hash of a model's numbers, which tells models apart."""
    total = hashlib.sha256()
    for name in ("mean", "faces", "identity", "expression", "mask"):
        total.update(getattr(model, name).tobytes())
    return total.hexdigest()[:16]


def runs_of(record: Mapping[str, Any], mode: str, lights: int | None = None) -> list[dict[str, Any]]:
    """The records of a mode (and of a number of shadows), sorted by seed."""
    runs = [r for r in record["runs"].values() if r["mode"] == mode and lights in (None, r["lights"])]
    return sorted(runs, key=lambda run: run["seed"])


def summary(record: Mapping[str, Any], mode: str) -> dict[int, dict[str, float]]:
    """Means over the heads for each number of shadows: distances at end and start, share gained, seconds."""
    result = {}
    for lights in sorted({run["lights"] for run in runs_of(record, mode)}):
        runs = runs_of(record, mode, lights)
        mean, start = (float(np.mean([run[k]["mean"] for run in runs])) for k in ("distance", "start_distance"))
        result[lights] = {
            "mean": mean,
            "hausdorff": float(np.mean([run["distance"]["hausdorff"] for run in runs])),
            "start_mean": start,
            "start_hausdorff": float(np.mean([run["start_distance"]["hausdorff"] for run in runs])),
            "gain": 1 - mean / start if start > 0 else 0.0,
            "seconds_per_iteration": float(np.mean([run["seconds_per_iteration"] for run in runs])),
        }
    return result


def rows(record: Mapping[str, Any], mode: str) -> tuple[list[str], list[list[str]]]:
    """Columns, and a row for each head, for the means and for the paper's means: mean and largest distance at the start, and of
    the results with 1 and with 3 shadows; milliseconds of a step.
    """
    means = summary(record, mode)
    columns = ["head", "start: mean", "max"]
    for lights in means:
        columns += [f"{lights}: mean", "max", "ms"]
    body = []
    for seed in sorted({run["seed"] for run in runs_of(record, mode)}):
        runs = {run["lights"]: run for run in runs_of(record, mode) if run["seed"] == seed}
        start = next(iter(runs.values()))["start_distance"]
        row = [str(seed), f"{start['mean']:.4f}", f"{start['hausdorff']:.3f}"]
        for lights in means:
            run = runs.get(lights)
            row += (
                [
                    f"{run['distance']['mean']:.4f}",
                    f"{run['distance']['hausdorff']:.3f}",
                    f"{1000 * run['seconds_per_iteration']:.1f}",
                ]
                if run
                else ["", "", ""]
            )
        body.append(row)
    first = next(iter(means.values()))
    row = ["mean", f"{first['start_mean']:.4f}", f"{first['start_hausdorff']:.3f}"]
    for entry in means.values():
        row += [f"{entry['mean']:.4f}", f"{entry['hausdorff']:.3f}", f"{1000 * entry['seconds_per_iteration']:.1f}"]
    body.append(row)
    if mode == "identity":
        row = ["paper", "", ""]
        for lights in means:
            mean, largest, seconds = PAPER[lights]
            row += [f"{mean:.3f}", f"{largest:.3f}", f"{1000 * seconds:.0f}"]
        body.append(row)
    return columns, body


def tables(record: Mapping[str, Any]) -> list[Table]:
    """Tables for the terminal, one for each mode."""
    modes = [mode for mode in _TITLES if runs_of(record, mode)]
    return [console.table(f"{_TITLES[mode]}: distances from 1 or 3 shadows, ms a step", *rows(record, mode)) for mode in modes]


def seen_expressions(record: Mapping[str, Any], lights: int) -> list[dict[str, Any]]:
    """Expressions, the best determined first: predicted deviation, error and true value, root mean squares over heads."""
    runs = [run for run in runs_of(record, "expression", lights) if "recovery" in run]
    names = [row["name"] for row in runs[0]["recovery"]] if runs else []
    result = []
    for name in names:
        entries = [next(row for row in run["recovery"] if row["name"] == name) for run in runs]
        mean_square = {k: float(np.sqrt(np.mean([e[k] ** 2 for e in entries]))) for k in ("deviation", "error", "true")}
        result.append({"name": name, **mean_square})
    return sorted(result, key=lambda row: row["deviation"])


def reading(record: Mapping[str, Any]) -> list[str]:
    """The report as lines of Markdown."""
    lines = ["# Faces from profile shadows", ""]
    for mode, title in _TITLES.items():
        if not runs_of(record, mode):
            continue
        lines += [f"## {title}", "", *markdown(*rows(record, mode)), ""]
        for lights, entry in summary(record, mode).items():
            shadows = f"{lights} shadow{'s' * (lights > 1)}"
            lines.append(f"- {shadows}: the mean distance is {entry['gain']:.0%} below that of the start.")
        lines.append("")
        for lights in summary(record, mode) if mode == "expression" else ():
            lines += _expressions(record, lights)
    return lines


def _expressions(record: Mapping[str, Any], lights: int) -> list[str]:
    entries = seen_expressions(record, lights)
    if not entries:
        return []
    seen = [row for row in entries if row["deviation"] <= SEEN]
    rest = [row for row in entries if row["deviation"] > SEEN]

    def rms(part: list[dict[str, Any]]) -> str:
        return f"{np.sqrt(np.mean([row['error'] ** 2 for row in part])):.2f}" if part else "-"

    table = [[row["name"], f"{row['deviation']:.2f}", f"{row['error']:.2f}", f"{row['true']:.2f}"] for row in seen]
    return [
        f"{lights} shadow{'s' * (lights > 1)}: of {len(entries)} expressions {len(seen)} can be seen (the image leaves a "
        f"standard deviation of at most {SEEN}, of 1). Error of these: {rms(seen)}, of the others: {rms(rest)}.",
        "",
        *markdown(["expression", "predicted deviation", "error", "size"], table),
        "",
    ]


def write(out: Path, record: Mapping[str, Any]) -> None:
    """Write `faces.md` and `convergence.png`."""
    with atomic(out / "faces.md") as temporary:
        temporary.write_text("\n".join(reading(record)) + "\n", encoding="utf-8")
    curves: dict[str, list[Any]] = {}
    for run in record["runs"].values():
        curves.setdefault(f"{run['mode']}, {run['lights']} shadow{'s' * (run['lights'] > 1)}", []).append(run["loss_curve"])
    note = "Curves of one colour are different heads."
    plots.plot_curves(out / "convergence.png", {"loss (difference of the shadows and prior)": curves}, caption=note)

"""Plot of the errors of all starts over the seconds of a fit."""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..io import plot_style
from .result import Step

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Width and height in inches, and most points of a curve.
_SIZE, _MOST_POINTS = (6.4, 3.1), 300
# Least distance of names of stages, as a share of the axis.
_APART = 0.09


def best_start(history: Sequence[Step]) -> int | None:
    """The start with the least error at the end of the last stage; None if no error is a number."""
    last = {step["start"]: step["error"] for step in history if step["stage"] == history[-1]["stage"]}
    finite = {start: error for start, error in last.items() if math.isfinite(error)}
    return min(finite, key=finite.__getitem__) if finite else None


def curves_svg(history: Sequence[Step], *, dark: bool = False) -> str:
    """The plot as SVG, with its letters as shapes; ``dark``: for pages with a dark background."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "curves.svg"
        draw_curves(path, history, dark=dark)
        return path.read_text(encoding="utf-8")


def draw_curves(path: str | os.PathLike[str], history: Sequence[Step], *, dark: bool = False) -> None:
    """Draw the plot into a file (.png, .pdf, .svg). The best start is blue and wide; lines mark its stages."""
    best = best_start(history)
    tint = plot_style.COLOURS[5] if dark else plot_style.COLOURS[0]
    others = sorted({step["start"] for step in history} - {best})
    with plot_style.drawn(path, *_SIZE, dark=dark) as figure:
        axes = figure.add_subplot()
        axes.set_xlabel("seconds")
        axes.set_ylabel("error [% of the target's brightness]")
        ends = []
        for start in others:
            seconds, errors = _curve(history, start)
            axes.plot(seconds, errors, color=plot_style.GREY, linewidth=0.9, alpha=0.7)
            ends.append(errors[-1] if len(errors) else math.nan)
        if best is not None:
            seconds, errors = _curve(history, best)
            axes.plot(seconds, errors, color=tint, linewidth=2.2, zorder=5)
        if any(0 < step["error"] < math.inf for step in history):
            axes.set_yscale("log")
        axes.set_xmargin(0.02)
        if best is not None:
            _mark_stages(axes, [step for step in history if step["start"] == best])
        # Names stand at the ends of lines, where the limits of the axes are known.
        names = [(float(errors[-1]), f"start {best},\nthe best" if others else f"start {best}", tint)] if best is not None else []
        if others:
            grey = "#a7b0bb" if dark else "#5f5f5f"
            names.append((float(np.median(ends)), "1 other\nstart" if len(others) == 1 else f"{len(others)} other\nstarts", grey))
        plot_style.label_ends(axes, names)


def _curve(history: Sequence[Step], start: int) -> tuple[list[float], list[float]]:
    """Seconds and errors, in percent, of a start; errors that no logarithmic axis has are left out."""
    steps = [step for step in history if step["start"] == start and 0 < step["error"] < math.inf]
    kept = sorted(set(np.linspace(0, len(steps) - 1, min(len(steps), _MOST_POINTS)).round().astype(int).tolist()))
    return [steps[k]["seconds"] for k in kept], [100 * steps[k]["error"] for k in kept]


def _mark_stages(axes: Axes, steps: Sequence[Step]) -> None:
    """A dotted line at the begin of each stage, with the stage's name where there is room."""
    low, high = axes.get_xlim()
    free = -math.inf
    stages = [step for k, step in enumerate(steps) if k == 0 or step["stage"] != steps[k - 1]["stage"]]
    for step in stages:
        place = (step["seconds"] - low) / (high - low)
        if not math.isfinite(place):
            continue
        axes.axvline(step["seconds"], color=plot_style.GREY, linewidth=0.7, linestyle=":")
        name = step["stage"].replace("$", r"\$")
        if place > free:
            axes.text(place + 0.006, 0.985, name, transform=axes.transAxes, va="top", fontsize=7.5, alpha=0.85)
            free = place + max(_APART, 0.0125 * len(name))

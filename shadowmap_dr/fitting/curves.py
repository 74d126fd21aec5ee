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
# Errors below this are not drawn: no rounding reaches them.
_LEAST = 1e-9
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
        if any(_is_drawn(step) for step in history):
            axes.set_yscale("log")
        axes.set_xmargin(0.02)
        ends = []
        for start in others:
            seconds, errors = _curve(history, start)
            axes.plot(seconds, errors, color=plot_style.GREY, linewidth=0.9, alpha=0.7)
            ends += errors[-1:]
        names = []
        if best is not None:
            seconds, errors = _curve(history, best)
            axes.plot(seconds, errors, color=tint, linewidth=2.2, zorder=5)
            if errors:
                _mark_stages(axes, [step for step in history if step["start"] == best])
            names.append((errors[-1] if errors else math.nan, f"start {best}" + (",\nthe best" if others else ""), tint))
        if others:
            count = "1 other\nstart" if len(others) == 1 else f"{len(others)} other\nstarts"
            names.append((float(np.median(ends)) if ends else math.nan, count, "#a7b0bb" if dark else "#5f5f5f"))
        plot_style.label_ends(axes, names)


def _curve(history: Sequence[Step], start: int) -> tuple[list[float], list[float]]:
    """Seconds and errors, in percent, of a start."""
    steps = [step for step in history if step["start"] == start and _is_drawn(step)]
    kept = sorted(set(np.linspace(0, len(steps) - 1, min(len(steps), _MOST_POINTS)).round().astype(int).tolist()))
    return [steps[k]["seconds"] for k in kept], [100 * steps[k]["error"] for k in kept]


def _is_drawn(step: Step) -> bool:
    """True unless a logarithmic axis has no place for a step's error."""
    return math.isfinite(step["seconds"]) and _LEAST < step["error"] < math.inf


def _mark_stages(axes: Axes, steps: Sequence[Step]) -> None:
    """A dotted line at the begin of each stage, with the stage's name where there is room."""
    low, high = axes.get_xlim()
    free = -math.inf
    for k, step in enumerate(steps):
        if (k and step["stage"] == steps[k - 1]["stage"]) or not math.isfinite(step["seconds"]):
            continue
        place = (step["seconds"] - low) / (high - low)
        axes.axvline(step["seconds"], color=plot_style.GREY, linewidth=0.7, linestyle=":")
        name = step["stage"].replace("$", r"\$")
        if place > free:
            axes.text(place + 0.006, 0.985, name, transform=axes.transAxes, va="top", fontsize=7.5, alpha=0.85)
            free = place + max(_APART, 0.0125 * len(name))

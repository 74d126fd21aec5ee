"""Plot of the pose experiment: convergence over many runs."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...io import plot_style

COLOURS = {name: plot_style.colour(k) for k, name in enumerate(("shadows", "rasterizer", "mitsuba"))}
_LIMIT_DEG = 0.2


def plot_convergence(
    path: str | os.PathLike[str], curves: Mapping[tuple[str, int], Mapping[str, Sequence[Sequence[float | None]]]]
) -> None:
    """Draw the median rotation error of the runs over the steps, and the band between the quartiles.

    Args:
        path: file to write (.png, .pdf, .svg).
        curves: (object, resolution) -> method -> a curve (degrees) for each run. Objects become rows, resolutions columns.
    """
    objects, resolutions = sorted({name for name, _ in curves}), sorted({resolution for _, resolution in curves})
    with plot_style.drawn(path, 1.8 + 3.2 * len(resolutions), 0.7 + 2.2 * len(objects), dpi=110) as figure:
        grid = figure.subplots(len(objects), len(resolutions), sharex=True, sharey=True, squeeze=False)
        labels: list[tuple[Any, list[tuple[float, str, str]]]] = []  # Any: Axes
        for i, name in enumerate(objects):
            for j, resolution in enumerate(resolutions):
                axes, ends = grid[i, j], []
                for method, runs in curves.get((name, resolution), {}).items():
                    errors = np.array(runs, np.float64)  # None, of a run that failed, becomes NaN
                    with warnings.catch_warnings():  # a step that no run reached leaves a gap in the plot
                        warnings.simplefilter("ignore", RuntimeWarning)
                        low, middle, high = np.nanpercentile(errors, (25, 50, 75), axis=0)
                    tint = COLOURS.get(method, plot_style.GREY)
                    axes.plot(middle, color=tint)
                    axes.fill_between(np.arange(len(middle)), low, high, color=tint, alpha=0.25, linewidth=0)
                    ends.append((float(middle[-1]), method, tint))
                axes.axhline(_LIMIT_DEG, color=plot_style.GREY, linestyle=":", linewidth=1)
                axes.set_yscale("log")
                axes.set_title(f"{name}, {resolution} x {resolution} pixels")
                if j == 0:
                    axes.set_ylabel("rotation error [degrees]")
                if i == len(objects) - 1:
                    axes.set_xlabel("step")
                if j == len(resolutions) - 1:
                    labels.append((axes, ends))
        for labelled in labels:  # only now, since the limits are those of all panels
            plot_style.label_ends(*labelled)
        bands = "Lines: medians of the runs. Bands: from the lower to the upper quartile."
        plot_style.caption(figure, f"{bands} Dotted: {_LIMIT_DEG} degrees, the limit.")

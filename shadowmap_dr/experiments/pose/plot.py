"""Plot of the pose experiment: convergence over many runs."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence

import numpy as np

from ...io.files import atomic

COLOURS = {"shadows": "C0", "rasterizer": "C1", "mitsuba": "C2"}
_LIMIT_DEG = 0.2


def plot_convergence(
    path: str | os.PathLike[str], curves: Mapping[tuple[str, int], Mapping[str, Sequence[Sequence[float | None]]]]
) -> None:
    """Draw the median rotation error of the runs over the steps, and the band between the quartiles.

    Args:
        path: file to write (.png, .pdf, .svg).
        curves: (object, resolution) -> method -> a curve (degrees) for each run. Objects become rows, resolutions columns.
    """
    from matplotlib.figure import Figure  # without pyplot there is no global state and no display is needed

    objects, resolutions = sorted({name for name, _ in curves}), sorted({resolution for _, resolution in curves})
    figure = Figure(figsize=(1.2 + 3.4 * len(resolutions), 0.6 + 2.2 * len(objects)), layout="constrained")
    grid = figure.subplots(len(objects), len(resolutions), sharex=True, sharey=True, squeeze=False)
    handles = {}
    for i, name in enumerate(objects):
        for j, resolution in enumerate(resolutions):
            axes = grid[i, j]
            for method, runs in curves.get((name, resolution), {}).items():
                errors = np.array(runs, np.float64)  # None, of a run that failed, becomes NaN
                with warnings.catch_warnings():  # a step that no run reached leaves a gap in the plot
                    warnings.simplefilter("ignore", RuntimeWarning)
                    low, middle, high = np.nanpercentile(errors, (25, 50, 75), axis=0)
                (line,) = axes.plot(middle, COLOURS.get(method, "0.3"), linewidth=1.4, label=method)
                axes.fill_between(np.arange(len(middle)), low, high, color=line.get_color(), alpha=0.25, linewidth=0)
                handles[method] = line
            axes.axhline(_LIMIT_DEG, color="0.5", linestyle=":", linewidth=1)
            axes.set_yscale("log")
            axes.grid(True, alpha=0.3)
            axes.set_title(f"{name}, {resolution} x {resolution}", fontsize=9)
    figure.supxlabel("step", fontsize=10)
    figure.supylabel("rotation error [degrees]", fontsize=10)
    figure.legend(handles.values(), handles.keys(), loc="outside upper center", ncols=len(handles), fontsize=9, frameon=False)
    with atomic(path) as temporary:
        figure.savefig(temporary, dpi=110)

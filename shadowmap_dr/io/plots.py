"""Plots of curves and sheets of images."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from . import plot_style
from .images import to_srgb

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Image = npt.NDArray[np.floating[Any]]
#: Title of a row -> title of a column -> image.
Rows = Mapping[str, Mapping[str, Image]]
#: Columns whose titles begin with this are differences: numbers, which are drawn in colours with a bar.
DIFFERENCE = "difference"
# Share of pixels below the end of a colour bar, in percent.
_MOST = 99.7


@np.errstate(over="ignore", invalid="ignore")  # the margins of axes for numbers near the largest ones
def plot_curves(
    path: str | os.PathLike[str],
    panels: Mapping[str, Mapping[str, Sequence[Sequence[float]]]],
    x_label: str = "iteration",
    columns: int | None = None,
    caption: str = "Curves of one colour are runs with the same settings.",
) -> None:
    """Plot curves over their index, one panel beside the other, with logarithmic vertical axes.

    Args:
        path: file to write (.png, .pdf, .svg).
        panels: vertical axis label -> legend entry -> curves (several curves of one entry, e.g. runs, share a colour).
        x_label: label of the horizontal axes.
        columns: panels in a row, or None for all.
        caption: line below the panels, if some entry has several curves.
    """
    from matplotlib.ticker import MaxNLocator

    across = max(1, min(columns or len(panels), len(panels)))
    down = max(1, math.ceil(len(panels) / across))
    with plot_style.drawn(path, 4.6 * across, 3.2 * down) as figure:
        for i, (y_label, entries) in enumerate(panels.items()):
            axes = figure.add_subplot(down, across, i + 1)
            ends = []
            for k, (label, curves) in enumerate(entries.items()):
                for curve in curves:
                    axes.plot(curve, color=plot_style.colour(k), linestyle=plot_style.dash(k), alpha=0.85)
                last = [value for curve in curves for value in list(curve)[-1:] if value is not None]
                ends.append((float(np.median(last)) if last else math.nan, label, plot_style.colour(k)))
            if any(_positive(curve) for curves in entries.values() for curve in curves):
                axes.set_yscale("log")
            axes.set_xlabel(x_label)
            axes.set_ylabel(y_label)
            axes.set_xmargin(0.02)
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
            plot_style.label_ends(axes, ends)
        if any(len(curves) > 1 for entries in panels.values() for curves in entries.values()):
            plot_style.caption(figure, caption)


def image_sheet(path: str | os.PathLike[str], rows: Rows, size: float = 2.2, most: float | None = None) -> None:
    """Draw images in a grid: row title -> column title -> linear (H, W, 3) or (H, W, 1) image.

    Columns whose titles begin with `DIFFERENCE` are drawn as numbers, the mean over the channels, with one scale for the sheet
    and a colour bar; negative numbers make it signed. The scale ends at ``most``, or so that nearly all pixels lie within.
    """
    differences = [_mean(image) for row in rows.values() for title, image in row.items() if title.startswith(DIFFERENCE)]
    limit = most or max((_limit(values) for values in differences), default=1.0)
    signed = any(float(np.nanmin(values)) < 0 for values in differences)
    low, name = (-limit, plot_style.SIGNED) if signed else (0.0, plot_style.SEQUENTIAL)
    with plot_style.drawn(path, *_sheet_size(rows, size, bar=bool(differences)), dpi=120) as figure:
        grid = _grid(figure, rows)
        for (_, title, image), axes in grid:
            if title.startswith(DIFFERENCE):
                axes.imshow(np.nan_to_num(_mean(image)), cmap=name, vmin=low, vmax=limit)
            else:
                pixels = to_srgb(np.nan_to_num(image))
                axes.imshow(np.repeat(pixels, 3, axis=2) if pixels.shape[2] == 1 else pixels[..., :3])
        if differences:
            label = "difference" if signed else "absolute difference"
            plot_style.colour_bar(figure, [axes for _, axes in grid], name, low, limit, label)


def signed_sheet(path: str | os.PathLike[str], rows: Rows, size: float = 2.0, label: str | Mapping[str, str] = "value") -> None:
    """Draw signed images (H, W) in a grid, blue below zero and red above, with one scale and a colour bar for each row.

    ``label``, with the unit, is that of all bars, or each row's.
    """
    with plot_style.drawn(path, *_sheet_size(rows, size, bar=True), dpi=120) as figure:
        grid = _grid(figure, rows)
        for row_title, row in rows.items():
            limit = max(_limit(image) for image in row.values())
            own = [(image, axes) for (title, _, image), axes in grid if title == row_title]
            for image, axes in own:
                axes.imshow(np.nan_to_num(image), cmap=plot_style.SIGNED, vmin=-limit, vmax=limit, interpolation="antialiased")
            shown = label if isinstance(label, str) else label[row_title]
            plot_style.colour_bar(figure, [axes for _, axes in own], plot_style.SIGNED, -limit, limit, shown)


def _grid(figure: Any, rows: Rows) -> list[tuple[tuple[str, str, Image], Axes]]:  # Any: Figure
    """Empty plots with titles for all images: (title of the row, title of the column, image) and axes."""
    columns = max(len(row) for row in rows.values())
    grid = []
    for i, (row_title, row) in enumerate(rows.items()):
        for j, (column_title, image) in enumerate(row.items()):
            axes = figure.add_subplot(len(rows), columns, i * columns + j + 1)
            axes.set(xticks=[], yticks=[])
            axes.grid(False)
            axes.spines[:].set(visible=True, color="0.8", linewidth=0.5)
            if i == 0 or list(row) != list(next(iter(rows.values()))):
                axes.set_title(column_title, fontsize=9)
            if j == 0:
                axes.set_ylabel(row_title, fontsize=9)
            grid.append(((row_title, column_title, image), axes))
    return grid


def _sheet_size(rows: Rows, size: float, *, bar: bool) -> tuple[float, float]:
    """Width and height of a sheet in inches; ``size`` is the width of an image."""
    columns = max(len(row) for row in rows.values())
    aspect = max(image.shape[0] / image.shape[1] for row in rows.values() for image in row.values())
    return size * columns + (1.0 if bar else 0.0) + 0.3, (size * aspect + 0.15) * len(rows) + 0.3


def _mean(image: Image) -> Image:
    return image.mean(axis=2) if image.ndim == 3 else image


def _limit(values: Image) -> float:
    """End of a scale: nearly all magnitudes lie below it."""
    found = float(np.percentile(np.abs(np.nan_to_num(values)), _MOST))
    return found or float(np.abs(np.nan_to_num(values)).max()) or 1.0


def _positive(curve: Sequence[float]) -> bool:
    return any(value is not None and value > 0 and math.isfinite(value) for value in curve)

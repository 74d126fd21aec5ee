"""Plots of curves and sheets of images."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from .files import atomic
from .images import to_srgb

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Image = npt.NDArray[np.floating[Any]]
#: Title of a row -> title of a column -> image.
Rows = Mapping[str, Mapping[str, Image]]


@np.errstate(over="ignore", invalid="ignore")  # the margins of axes for numbers near the largest ones
def plot_curves(
    path: str | os.PathLike[str],
    panels: Mapping[str, Mapping[str, Sequence[Sequence[float]]]],
    x_label: str = "iteration",
    columns: int | None = None,
) -> None:
    """Plot curves over their index, one panel beside the other, with logarithmic vertical axes.

    Args:
        path: file to write (.png, .pdf, .svg).
        panels: vertical axis label -> legend entry -> curves (several curves of one entry, e.g. runs, share a colour).
        x_label: label of the horizontal axes.
        columns: panels in a row, or None for all.
    """
    from matplotlib.figure import Figure  # unlike pyplot it has no global state and needs no display

    across = max(1, min(columns or len(panels), len(panels)))
    down = math.ceil(len(panels) / across)
    figure = Figure(figsize=(5 * across, 4 * down), layout="constrained")
    for i, (y_label, entries) in enumerate(panels.items()):
        axes = figure.add_subplot(down, across, i + 1)
        for colour, (label, curves) in enumerate(entries.items()):
            for k, curve in enumerate(curves):
                axes.plot(curve, color=f"C{colour}", alpha=0.8, linewidth=1.2, label=label if k == 0 else None)
        if any(_positive(curve) for curves in entries.values() for curve in curves):
            axes.set_yscale("log")
        axes.set_xlabel(x_label)
        axes.set_ylabel(y_label)
        axes.grid(True, alpha=0.3)
        if i == 0 and entries:
            axes.legend()
    with atomic(path) as temporary:
        figure.savefig(temporary, dpi=150)


def image_sheet(path: str | os.PathLike[str], rows: Rows, size: float = 2.2) -> None:
    """Draw images in a grid: row title -> column title -> linear (H, W, 3) or (H, W, 1) image."""

    def draw(axes: Axes, image: Image, _: Mapping[str, Image]) -> None:
        pixels = to_srgb(np.nan_to_num(image))
        pixels = np.repeat(pixels, 3, axis=2) if pixels.shape[2] == 1 else pixels[..., :3]
        axes.imshow(pixels, interpolation="nearest")

    _grid(path, rows, size, draw)


def signed_sheet(path: str | os.PathLike[str], rows: Rows, size: float = 2.0) -> None:
    """Draw signed images (H, W) in a grid, blue below zero and red above, with one scale for each row."""

    def draw(axes: Axes, image: Image, row: Mapping[str, Image]) -> None:
        limit = max(float(np.percentile(np.abs(other), 99.7)) for other in row.values()) or 1.0
        axes.imshow(np.nan_to_num(image), cmap="RdBu_r", vmin=-limit, vmax=limit, interpolation="antialiased")

    _grid(path, rows, size, draw)


def _grid(
    path: str | os.PathLike[str], rows: Rows, size: float, draw: Callable[[Axes, Image, Mapping[str, Image]], None]
) -> None:
    """Write a grid of images with titles; ``draw(axes, image, row)`` draws one image."""
    from matplotlib.figure import Figure  # unlike pyplot it has no global state and needs no display

    columns = max(len(row) for row in rows.values())
    aspect = max(image.shape[0] / image.shape[1] for row in rows.values() for image in row.values())
    figure = Figure(figsize=(size * columns, size * aspect * len(rows) + 0.3), layout="constrained")
    for i, (row_title, row) in enumerate(rows.items()):
        for j, (column_title, image) in enumerate(row.items()):
            axes = figure.add_subplot(len(rows), columns, i * columns + j + 1)
            draw(axes, image, row)
            axes.set_xticks([])
            axes.set_yticks([])
            if i == 0:
                axes.set_title(column_title, fontsize=9)
            if j == 0:
                axes.set_ylabel(row_title, fontsize=9)
    with atomic(path) as temporary:
        figure.savefig(temporary, dpi=120)


def _positive(curve: Sequence[float]) -> bool:
    return any(value > 0 and math.isfinite(value) for value in curve)

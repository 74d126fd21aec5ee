"""What experiments leave behind: records as JSON, tables for the terminal, plots and sheets of images."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from .errors import ShadowmapError
from .io import atomic, to_srgb


def write_json(path: str | os.PathLike[str], value: Any) -> None:
    """Write `value` (dicts, sequences, NumPy arrays and scalars; numbers that are not finite become null)."""
    text = json.dumps(plain(value), indent=1, allow_nan=False)
    with atomic(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def read_json(path: str | os.PathLike[str]) -> Any:
    """The content of a JSON file, or a ShadowmapError that names it."""
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ShadowmapError(f"no file {str(path)!r}.") from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ShadowmapError(f"cannot read {path}: {' '.join(str(error).split())}.") from error


def read_record(path: str | os.PathLike[str], settings: Mapping[str, Any], *parts: str) -> dict[str, Any]:
    """The record of an earlier call, to go on with: a mapping with these ``settings``, and mappings of the names ``parts``.

    ShadowmapError where the file holds no such record, or one of other settings.
    """
    record, advice = read_json(path), "choose another folder, or leave out --resume"
    if not isinstance(record, dict) or not all(isinstance(record.get(part), dict) for part in ("settings", *parts)):
        raise ShadowmapError(f"{path} is no record of this experiment: {advice}.")
    found = {key: record["settings"].get(key) for key in settings}
    if found != plain(settings):
        raise ShadowmapError(f"{path} belongs to a run with other settings, {found}: {advice}.")
    return record


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """A table for the terminal: the first column left-aligned, all others right-aligned."""
    result = Table(title=title, title_justify="left", box=SIMPLE_HEAD)  # narrow enough for 80 columns
    for i, column in enumerate(columns):
        result.add_column(column, justify="left" if i == 0 else "right")
    for row in rows:
        result.add_row(*row)
    return result


def progress(console: Console) -> Progress:
    """A progress display; add one task for each part of the work, with a field `note`."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[note]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
    )


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
    from matplotlib.figure import Figure  # without pyplot there is no global state and no display is needed

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


def image_sheet(
    path: str | os.PathLike[str], rows: Mapping[str, Mapping[str, npt.NDArray[np.floating[Any]]]], size: float = 2.2
) -> None:
    """Draw images in a grid: row title -> column title -> linear (H, W, 3) or (H, W, 1) image."""
    from matplotlib.figure import Figure

    columns = max(len(row) for row in rows.values())
    aspect = max(image.shape[0] / image.shape[1] for row in rows.values() for image in row.values())
    figure = Figure(figsize=(size * columns, size * aspect * len(rows) + 0.3), layout="constrained")
    for i, (row_title, row) in enumerate(rows.items()):
        for j, (column_title, image) in enumerate(row.items()):
            axes = figure.add_subplot(len(rows), columns, i * columns + j + 1)
            pixels = to_srgb(np.nan_to_num(image))
            pixels = np.repeat(pixels, 3, axis=2) if pixels.shape[2] == 1 else pixels[..., :3]
            axes.imshow(pixels, interpolation="nearest")
            axes.set_xticks([])
            axes.set_yticks([])
            if i == 0:
                axes.set_title(column_title, fontsize=9)
            if j == 0:
                axes.set_ylabel(row_title, fontsize=9)
    with atomic(path) as temporary:
        figure.savefig(temporary, dpi=120)


def plain(value: Any) -> Any:
    """`value` as JSON can hold it: NumPy values become numbers and lists, numbers that are not finite None."""
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    if value is None or isinstance(value, (str, int, bool)):
        return value
    raise TypeError(f"{type(value).__name__} is no JSON value")


def _positive(curve: Sequence[float]) -> bool:
    return any(value > 0 and math.isfinite(value) for value in curve)

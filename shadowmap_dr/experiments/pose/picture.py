"""The picture of a problem: reference, start, the end of each method, and errors over time."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ...io import plot_style
from ...io.images import to_srgb
from .methods import Image
from .plot import COLOURS
from .record import RECOVERED_DEG, RECOVERED_X100, seconds_to_stay
from .scene import pose_errors

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Names of methods for readers, in two lines.
NAMES = {
    "shadows": "shadowmap_dr,\nwith shadows",
    "rasterizer": "shadowmap_dr,\nwithout shadows",
    "mitsuba": "Mitsuba's projective\nintegrator",
}
# The same for labels of curves.
_SHORT = {"shadows": "with shadows", "rasterizer": "without shadows", "mitsuba": "Mitsuba"}
# Errors of a run: title of the plot, curve, bound below which a pose is found.
_ERRORS = (
    ("Error of the rotation [degrees]", "rotation_error_curve", RECOVERED_DEG),
    ("Error of the position [1/100 of a unit; the object is 2 units long]", "translation_error_curve", RECOVERED_X100),
)
# Sizes in inches: width of an image, height of texts above it, height of a plot, of the heading and of a line of notes.
_TILE, _ABOVE, _PLOT, _HEADING, _LINE = 2.35, 0.85, 2.75, 0.6, 0.19
# Letters of notes to an inch.
_LETTERS = 15
_INK, _PALE = "0.15", "0.4"


@dataclass
class Course:
    """A method in the picture: images of its first run, and records of all its runs so far."""

    start: Image
    result: Image
    records: list[dict[str, Any]] = field(default_factory=list)


def draw(
    path: str | os.PathLike[str], heading: str, reference: Image, courses: Mapping[str, Course], notes: Sequence[str] = ()
) -> None:
    """Draw the picture of a problem into a file (.png, .pdf, .svg).

    Args:
        heading: title.
        reference: linear image (H, W, C).
        courses: by the name of the method, in the order of the columns; at least one.
        notes: lines below the plots.
    """
    columns = max(2 + len(courses), 4)  # places for images, the last of which may be empty
    rows = [_ABOVE + _TILE * reference.shape[0] / reference.shape[1], _PLOT]
    width = columns * _TILE
    lines = [line for note in notes for line in textwrap.wrap(note, int(_LETTERS * width))]
    below = 0.1 + _LINE * len(lines)
    height = _HEADING + sum(rows) + below
    with plot_style.drawn(path, width, height, dpi=140) as figure:
        layout: Any = figure.get_layout_engine()  # Any: the constrained one
        layout.set(rect=(0, below / height, 1, 1 - (_HEADING + below) / height), w_pad=0.06, h_pad=0.05, hspace=0.03)
        figure.text(0.012, 1 - 0.14 / height, heading, size=14, weight="bold", va="top", color=_INK)
        figure.text(0.012, 0.07 / height, "\n".join(lines), size=8.5, va="bottom", color=_PALE, linespacing=1.5)
        grid = figure.add_gridspec(2, 1, height_ratios=rows)
        upper, lower = grid[0].subgridspec(1, columns), grid[1].subgridspec(1, len(_ERRORS))
        _images([figure.add_subplot(upper[k]) for k in range(2 + len(courses))], reference, courses)
        _curves([figure.add_subplot(lower[k]) for k in range(len(_ERRORS))], courses)


def _images(grid: Sequence[Axes], reference: Image, courses: Mapping[str, Course]) -> None:
    """The row of images, each below its title."""
    # The method without shadows has a start without a shadow.
    first = next((courses[name] for name in ("shadows", "mitsuba") if name in courses), next(iter(courses.values())))
    rotation, offset = pose_errors(first.records[0]["start"])
    by = "path-traced" if first.records[0]["reference"] == "mitsuba" else "rendered"
    tiles = [
        (reference, "Reference image", _INK, f"{by},\n{reference.shape[1]} x {reference.shape[0]} pixels"),
        (first.start, "Start", _INK, f"{rotation:.1f}° and {offset / 100:.2f} units off,\nthe same for all methods"),
    ]
    tiles += [
        (course.result, NAMES.get(name, name), COLOURS.get(name, _INK), _verdict(course.records))
        for name, course in courses.items()
    ]
    for axes, (image, title, tint, text) in zip(grid, tiles, strict=True):
        pixels = to_srgb(np.nan_to_num(image))
        axes.imshow(np.repeat(pixels, 3, axis=2) if pixels.shape[2] == 1 else pixels[..., :3])
        # The empty title keeps the room for both texts.
        axes.set_title("\n" * 4, size=9.5, pad=4)
        _above(axes, 34, title, size=10.5, weight="bold", color=tint)
        _above(axes, 5, text, size=9, color=_INK, linespacing=1.35)
        axes.set(xticks=[], yticks=[])
        axes.grid(False)
        axes.spines[:].set_visible(False)


def _above(axes: Axes, points: float, text: str, **style: Any) -> None:  # Any: Matplotlib's
    """Write a text above a plot, left-aligned with it."""
    axes.annotate(text, (0, 1), (0, points), xycoords="axes fraction", textcoords="offset points", va="bottom", **style)


def _verdict(records: Sequence[dict[str, Any]]) -> str:
    """Two lines about the runs of a method: whether the pose was found, and the seconds."""
    first, found = records[0], sum(record["recovered"] for record in records)
    if first["rotation_error_deg"] is None:
        return "failed"
    error = f"{_short(first['rotation_error_deg'])}°"
    offset = first["translation_error_x100"] / 100
    digits = 3 if offset > 0.01 else 4 if offset >= 5e-5 else 5
    end = f"{'found' if first['recovered'] else 'not found'}: {error}, {offset:.{digits}f} units off"
    if len(records) > 1:
        end = f"found {found} of {len(records)}; here {error} off"
    curve = first.get("seconds_curve")
    step = "" if not curve else f" (the first {_seconds(curve[0])})"
    return f"{end}\n{first['iterations']} steps: {_seconds(first['seconds_total'])}{step}"


def _curves(grid: Sequence[Axes], courses: Mapping[str, Course]) -> None:
    """Errors over the seconds of the runs, on logarithmic axes."""
    times = [_times(record) for course in courses.values() for record in course.records]
    drawn = [values[values > 0] for values in times if np.isfinite(values).any()]
    low = min((float(values[0]) for values in drawn if len(values)), default=0.01)
    high = max((float(values[-1]) for values in drawn if len(values)), default=1.0)
    low, high = 0.7 * low, 1.25 * max(high, 2 * low)
    for axes, (title, curve, bound) in zip(grid, _ERRORS, strict=True):
        axes.set_title(title, loc="left", size=10, color=_INK)
        axes.set(xscale="log", yscale="log", xlabel="seconds, compilation of kernels included")
        lowest, highest = _span([record[curve] for course in courses.values() for record in course.records])
        axes.set(xlim=(low, high), ylim=(lowest, highest))
        axes.axhspan(lowest, bound, color="0.5", alpha=0.13, linewidth=0)
        axes.text(low * 1.06, bound * 0.85, f"at the pose: below {bound:g}", size=8.5, color=_PALE, va="top")
        for name, course in courses.items():
            _course(axes, name, course, curve, low, single=len(course.records) == 1)
    _label(grid[-1], courses)


def _course(axes: Axes, name: str, course: Course, curve: str, low: float, *, single: bool) -> None:
    """The curves of a method, and a dot where the first run has come to stay at the pose."""
    tint = COLOURS.get(name, _INK)
    for k, record in enumerate(course.records):
        errors, times = np.array(record[curve], np.float64), _times(record)
        # The start stands until the first step is done.
        axes.plot([low, *times[1:]], errors, color=tint, linewidth=2.0 if single else 1.0, alpha=1.0 if single or not k else 0.4)
    stay = seconds_to_stay(course.records[0], _times(course.records[0]))
    if single and stay is not None:
        seconds, step = stay
        value = course.records[0][curve][step]
        axes.plot([seconds], [value], "o", color=tint, markersize=7, markeredgecolor="white", zorder=5)
        axes.annotate(
            f"{_seconds(seconds)}", (seconds, value), (0, 9), textcoords="offset points", size=9.5, weight="bold", color=tint,
            ha="center", va="bottom", zorder=6,
            bbox={"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.85},
        )  # fmt: skip


def _label(axes: Axes, courses: Mapping[str, Course]) -> None:
    """Names of the methods beside the ends of their curves."""
    ends = [
        (float(np.median([_last(record) for record in course.records])), _SHORT.get(name, name), COLOURS.get(name, _INK))
        for name, course in courses.items()
    ]
    plot_style.label_ends(axes, ends)


def _last(record: Mapping[str, Any]) -> float:
    value = record["translation_error_x100"]
    return np.nan if value is None else float(value)


def _times(record: Mapping[str, Any]) -> npt.NDArray[np.float64]:
    """Seconds from the begin of a run to each pose of its curves, (N + 1,)."""
    curve = record.get("seconds_curve")
    if curve is None:  # records of earlier versions
        each = record["seconds_per_iteration"]
        return np.arange(len(record["rotation_error_curve"]), dtype=np.float64) * (np.nan if each is None else each)
    return np.array([0.0, *(np.nan if value is None else value for value in curve)], np.float64)


def _span(curves: Sequence[Sequence[float | None]]) -> tuple[float, float]:
    """Limits of an axis for errors: all but the deepest dips, in which a curve crosses zero."""
    values = np.array([value for curve in curves for value in curve if value is not None and value > 0], np.float64)
    if not len(values):
        return 0.01, 100.0
    return min(float(np.percentile(values, 3)) * 0.7, 0.05), float(values.max()) * 1.5


def _short(value: float) -> str:
    """A number with two significant digits, and no more than three places."""
    return f"{value:.3f}" if value < 0.1 else f"{value:.2f}" if value < 1 else f"{value:.1f}"


def _seconds(value: float | None) -> str:
    if value is None:
        return "?"
    return f"{value:.2f} s" if value < 1 else f"{value:.1f} s" if value < 10 else f"{value:.0f} s"

"""One style for all plots: sizes of letters, colours that colour-blind people can tell apart, labels at the ends of lines.

Colours are those of M. Okabe and K. Ito, "Color Universal Design", 2008, without their yellow, which is too pale for lines.
"""

from __future__ import annotations

import os
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from .files import atomic

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Blue, vermilion, green, purple, orange, sky blue, dark grey.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#4D4D4D")
#: Limits and other lines that are no data.
GREY = "#808080"
#: Colour maps of numbers from zero on, and of signed numbers.
SEQUENTIAL, SIGNED = "viridis", "RdBu_r"
# Further series are told apart by their dashes and markers.
_DASHES, _MARKERS = ("-", "--", "-.", ":"), ("o", "s", "^", "D", "v", "P", "X")
_STYLE: dict[str, Any] = {
    **{"font.size": 9.0, "axes.titlesize": 10.0, "axes.labelsize": 9.0, "figure.labelsize": 9.0, "legend.fontsize": 8.5},
    **{"xtick.labelsize": 8.5, "ytick.labelsize": 8.5, "lines.linewidth": 1.4, "lines.markersize": 4.0, "legend.frameon": False},
    **{"axes.spines.top": False, "axes.spines.right": False, "axes.grid": True, "grid.alpha": 0.3, "grid.linewidth": 0.6},
    **{"axes.formatter.useoffset": False, "axes.axisbelow": True, "image.interpolation": "nearest"},
}
# Changes for pages with a dark background, which shows through.
_DARK: dict[str, Any] = {
    **dict.fromkeys(
        ("text.color", "axes.labelcolor", "axes.titlecolor", "xtick.color", "ytick.color", "axes.edgecolor"), "#e9ecef"
    ),
    **dict.fromkeys(("figure.facecolor", "axes.facecolor"), "none"),
    **{"grid.color": "#8a939e"},
}
# Distance of labels at the ends of lines, in points.
_LABEL_HEIGHT = 11.0
# Mean width of a letter of captions, in inches.
_LETTER_WIDTH = 0.066


def colour(number: int) -> str:
    """Colour of a series. There are seven; the eighth is the first again."""
    return COLOURS[number % len(COLOURS)]


def dash(number: int) -> str:
    """Line style of a series: solid for the first seven, dashed for the next."""
    return _DASHES[number // len(COLOURS) % len(_DASHES)]


def marker(number: int) -> str:
    """Marker of a series."""
    return _MARKERS[number % len(_MARKERS)]


@contextmanager
def drawn(path: str | os.PathLike[str], width: float, height: float, dpi: int = 130, *, dark: bool = False) -> Iterator[Figure]:
    """A figure in this style, to be drawn on in the block, which is written into a file (.png, .pdf, .svg) at its end.

    ``width`` and ``height`` are in inches. With ``dark`` it is transparent, and its letters are light.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure  # without pyplot there is no global state and no display is needed

    style: Any = {**_STYLE, **(_DARK if dark else {})}  # Any: Matplotlib's own names of settings
    with rc_context(style):
        figure = Figure(figsize=(width, height), layout="constrained")
        yield figure
        _write_out_numbers(figure)
        with atomic(path) as temporary:
            figure.savefig(temporary, dpi=dpi)


def _write_out_numbers(figure: Figure) -> None:
    """Label logarithmic axes with 30, 0.3 and 1,000,000, instead of powers of ten and products with them."""
    from matplotlib.ticker import LogFormatter

    class Plain(LogFormatter):
        def __call__(self, x: float, pos: int | None = None) -> str:
            text = f"{x:g}" if abs(x) < 1e5 else f"{x:,.0f}"
            return text if super().__call__(x, pos) else ""

    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            if isinstance(axis.get_major_formatter(), LogFormatter):  # others have labels of their own
                axis.set_major_formatter(Plain())
                axis.set_minor_formatter(Plain(labelOnlyBase=False, minor_thresholds=(1.2, 0.5)))


def label_ends(axes: Axes, ends: Sequence[tuple[float, str, str]]) -> None:
    """Write labels to the right of a plot, at the heights of the ends of lines, and apart from each other.

    Args:
        axes: with all its lines, and the scale of its vertical axis.
        ends: height in data coordinates (NaN: at the bottom), label, colour.
    """
    if not ends:
        return
    low, high = (axes.transAxes.inverted().transform(axes.transData.transform((0.0, y)))[1] for y in axes.get_ylim())
    heights = []
    with np.errstate(all="ignore"):
        for y, _, _ in ends:
            place = axes.transAxes.inverted().transform(axes.transData.transform((axes.get_xlim()[1], y)))[1]
            heights.append(float(np.clip(place, low, high)) if np.isfinite(place) else low)
    figure: Any = axes.get_figure()  # Any: a Figure, which is all that is drawn on here
    lines = max(text.count("\n") + 1 for _, text, _ in ends)
    gap = lines * _LABEL_HEIGHT / (72 * figure.get_size_inches()[1] * axes.get_position().height)
    order = np.argsort(heights, kind="stable")
    places = _apart([heights[k] for k in order], gap, high)
    for k, place in zip(order, places, strict=True):
        _, text, tint = ends[k]
        axes.text(1.02, place, text, color=tint, transform=axes.transAxes, va="center", ha="left", fontsize=8.5, clip_on=False)


def _apart(heights: Sequence[float], gap: float, top: float) -> list[float]:
    """Ascending heights, moved so that neighbours are at least a gap apart, and the uppermost is no higher than the top."""
    places: list[float] = []
    for height in heights:
        places.append(max(height, places[-1] + gap) if places else height)
    limit = top
    for k in range(len(places) - 1, -1, -1):
        places[k] = min(places[k], limit)
        limit = places[k] - gap
    return places


def caption(figure: Figure, text: str) -> None:
    """Write a text below all plots, for instance the meaning of bands and bars. It takes as many lines as it needs."""
    letters = max(20, int(figure.get_size_inches()[0] / _LETTER_WIDTH))
    figure.supxlabel(textwrap.fill(text, letters), fontsize=8.5, color="0.3")


def colour_bar(figure: Figure, axes: Sequence[Axes], name: str, low: float, high: float, label: str) -> None:
    """Draw the colour bar of images that were drawn with a colour map between two values."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    scale = ScalarMappable(Normalize(low, high), name)
    bar = figure.colorbar(scale, ax=list(axes), label=label, shrink=0.8, extend="both" if low < 0 else "max", pad=0.02, aspect=25)
    bar.ax.tick_params(labelsize=8)

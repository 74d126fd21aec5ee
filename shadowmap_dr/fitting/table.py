"""The table of estimates: a row for each number, rounded by its interval."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from rich.table import Table

from ..io import console
from .result import Estimate, FitResult

#: Half-width of numbers that the pictures do not determine.
NOT_DETERMINED = "not determined"
#: Columns of the table, as `Row` has them.
COLUMNS = ("estimate", "number", "start", "fit", "± 95 %", "unit")

# Significant digits: of numbers without an interval, and the most of any (single precision has no more).
_DIGITS, _MOST_DIGITS = 4, 7
# First digits of half-widths that keep two digits: with one, 0.014 would be 0.01.
_TWO_DIGITS = "12"
# Magnitudes that are written out; others have a power of ten.
_SMALL, _LARGE = 1e-4, 1e7


class Row(NamedTuple):
    """Texts of a row. ``half_width`` is empty if no interval was estimated, and `NOT_DETERMINED` if it is infinite."""

    name: str
    what: str
    start: str
    value: str
    half_width: str
    unit: str


def rows(estimate: Estimate) -> list[Row]:
    """Rows of an estimate: one for each labelled number, or a summary of a large array."""
    return list(_labelled(estimate)) if estimate.labels else [_summary(estimate)]


def table(result: FitResult) -> Table:
    """Table for the terminal. The name of an estimate stands in its first row only; intervals belong to fits that were found."""
    cells = []
    for estimate in result.estimates:
        for k, row in enumerate(rows(estimate)):
            shown = row if result.found else row._replace(half_width="")
            cells.append([row.name if k == 0 else "", *shown[1:]])
    title = "Estimates with 95 % intervals" if result.found else "No fit was found: numbers of the best attempt"
    made = console.table(title, COLUMNS, cells, wrapped=(0, 1))
    for column in (1, len(COLUMNS) - 1):
        made.columns[column].justify = "left"
    return made


def directions(result: FitResult) -> list[str]:
    """Lines with the fitted directions of lights, which the table has as turns from those of the scene file."""
    found = []
    for estimate in result.estimates:
        if "direction" in estimate.arrays:
            numbers = ", ".join(_significant(float(one)) for one in np.ravel(estimate.arrays["direction"]))
            found.append(f"{estimate.name}: light travels along ({numbers}).")
    return found


def rounded(value: float, half_width: float | None = None) -> tuple[str, str]:
    """Texts of a number and of the half-width of its interval, to the digits that the interval gives: "0.12" and "0.01".

    Half-widths have one significant digit, or two if the first is 1 or 2, as 0.014. Without an interval (None, inf, NaN) a number
    has four digits; the second text is then empty (None) or "not determined".
    """
    if half_width is None:
        return _significant(value), ""
    width = _round_width(abs(half_width))
    if not math.isfinite(width):
        return _significant(value), NOT_DETERMINED
    if not math.isfinite(value):
        return _significant(value), _significant(width)
    largest = max(abs(value), width)
    if not largest:
        return "0", "0"
    exponent = math.floor(math.log10(largest))
    places = _MOST_DIGITS - 1 - exponent
    places = min(places, _places(width)) if width else places
    if not _SMALL <= largest < _LARGE:
        text = _short_power(f"{value:.{max(0, exponent + places)}e}") if value else "0"
    else:
        text = f"{round(value, places) + 0.0:.{max(0, places)}f}"
    if not width and "." in text and "e" not in text:  # an exact number
        text = text.rstrip("0").rstrip(".")
    return text, _short_power(f"{width:g}")


def _labelled(estimate: Estimate) -> Iterator[Row]:
    for k, (label, unit) in enumerate(zip(estimate.labels, estimate.units, strict=True)):
        width = None if estimate.half_width is None else float(estimate.half_width[k])
        value, shown = rounded(float(estimate.values[k]), width)
        yield Row(estimate.name, label, _significant(float(estimate.start[k])), value, shown, unit)


def _summary(estimate: Estimate) -> Row:
    """Row of a large array: its size, the RMS of its changes, and its median interval."""
    unit = estimate.units[0] if estimate.units else ""
    change = np.square(estimate.values - estimate.start)
    moved = f"RMS change {_significant(float(np.sqrt(change.mean())))}" if len(change) else ""
    width = ""
    if estimate.half_width is not None and len(estimate.half_width):
        known = estimate.half_width[np.isfinite(estimate.half_width)]
        width = f"median {rounded(float(np.median(known)))[0]}" if len(known) else NOT_DETERMINED
        missing = len(estimate.half_width) - len(known)
        width += f", {missing} {NOT_DETERMINED}" if len(known) and missing else ""
    return Row(estimate.name, _size(estimate), "", moved, width, unit)


def _size(estimate: Estimate) -> str:
    if "texture" in estimate.arrays:
        height, across = estimate.arrays["texture"].shape[:2]
        return f"{across} x {height} pixels"
    if "vertices" in estimate.arrays:
        return f"{len(estimate.arrays['vertices'])} vertices"
    return f"{len(estimate.values)} numbers"


def _round_width(width: float) -> float:
    """A half-width with the digits that are shown."""
    two_digits = f"{width:.1e}"
    return float(two_digits if two_digits[0] in _TWO_DIGITS else f"{width:.0e}")


def _places(width: float) -> int:
    """Decimal places that a rounded half-width needs; negative for whole tens."""
    mantissa, _, power = f"{width:.1e}".partition("e")
    return (0 if mantissa.endswith(".0") else 1) - int(power)


def _significant(value: float) -> str:
    if math.isnan(value):
        return "no number"
    if math.isinf(value):
        return "-∞" if value < 0 else "∞"
    if value and not _SMALL <= abs(value) < _LARGE:
        return _short_power(f"{value:.{_DIGITS - 1}e}")
    if abs(value) >= 10**_DIGITS:
        return f"{value:.0f}"
    return f"{value + 0.0:.{_DIGITS}g}"


def _short_power(text: str) -> str:
    """1.2e-09 as 1.2e-9."""
    mantissa, e, power = text.partition("e")
    return f"{mantissa}e{int(power)}" if e else text

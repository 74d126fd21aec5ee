"""Sections of the report with numbers: the table of estimates, and the correlations as a small heat map."""

from __future__ import annotations

import math
from collections.abc import Iterator
from html import escape

import numpy as np

from ..io.plot_style import SIGNED
from .result import SMALL_ARRAYS, FitResult
from .table import NOT_DETERMINED, rows

#: Correlations above this are named in sentences.
STRONG = 0.95
# Most numbers of a heat map, most with texts in its cells, and most sentences.
_MOST, _MOST_TEXTS, _MOST_SENTENCES = 48, 12, 8


def estimates(result: FitResult) -> str:
    """The table of estimates, a group of rows for each."""
    head = "".join(f'<th scope="col">{title}</th>' for title in ("", "start", "fit", "± 95 %"))
    groups = "".join(_group(result))
    caption = (
        "± is half of the 95 % interval. Light that bounces, or a wrong shape, can shift a number by more."
        if result.found
        else "No fit was found: these are the numbers of the best attempt, and no estimates."
    )
    arrays = "\n\n".join(
        f"{estimate.name}, {name}:\n{_matrix(estimate.arrays[name])}"
        for estimate in result.estimates
        for name in SMALL_ARRAYS
        if name in estimate.arrays
    )
    details = f"<details><summary>Matrices and vectors in full</summary><pre>{escape(arrays)}</pre></details>" if arrays else ""
    return (
        f'<div class="wide"><table class="estimates"><caption>{caption}</caption>'
        f'<thead><tr>{head}<th scope="col" class="unit">unit</th></tr></thead>{groups}</table></div>{details}'
    )


def _group(result: FitResult) -> Iterator[str]:
    for estimate in result.estimates:
        yield f'<tbody><tr><th colspan="5" scope="rowgroup" class="name">{escape(estimate.name)}</th></tr>'
        for row in rows(estimate):
            half_width = (row.half_width or "not estimated") if result.found else "–"
            kind = ' class="open"' if NOT_DETERMINED in half_width else ' class="pale"' if not row.half_width else ""
            yield (
                f'<tr><th scope="row">{escape(row.what)}</th><td>{escape(row.start)}</td><td>{escape(row.value)}</td>'
                f'<td{kind}>{escape(half_width)}</td><td class="unit">{escape(row.unit)}</td></tr>'
            )
        yield "</tbody>"


def _matrix(array: np.ndarray) -> str:
    lines = np.atleast_2d(np.asarray(array, np.float64))
    return "\n".join("  ".join(f"{value: .6g}".ljust(12) for value in line).rstrip() for line in lines)


def strong_pairs(result: FitResult) -> list[tuple[str, str, float]]:
    """Names of pairs of numbers with a correlation above `STRONG`, and the correlation; the strongest first."""
    magnitudes = np.triu(np.abs(np.nan_to_num(result.correlations)), 1)
    pairs = [(i, j) for i, j in np.argwhere(magnitudes > STRONG).tolist()]
    pairs.sort(key=lambda pair: -magnitudes[pair])
    return [(result.names[i], result.names[j], float(result.correlations[i, j])) for i, j in pairs]


def correlations(result: FitResult) -> str:
    """The section of correlations; empty for fewer than two numbers."""
    if len(result.names) < 2:
        return ""
    pairs = strong_pairs(result)
    shown = "".join(
        f"<li><b>{escape(first)}</b> and <b>{escape(second)}</b> have the correlation {_signed(value)}.</li>"
        for first, second, value in pairs[:_MOST_SENTENCES]
    )
    more = len(pairs) - _MOST_SENTENCES
    shown += f"<li>So have {more} further {'pair' if more == 1 else 'pairs'}.</li>" if more > 0 else ""
    words = (
        f"<p>The pictures tell combinations of these numbers better than each one alone. Intervals include that; a target from "
        f"another side, or fewer things that vary, would make them narrower:</p>"
        f"<ul>{shown}</ul>"
        if pairs
        else f"<p>No two numbers have a correlation above {STRONG}: the pictures tell all of them apart.</p>"
        if np.isfinite(result.correlations).all()
        else f"<p>No two of the determined numbers have a correlation above {STRONG}.</p>"
    )
    too_many = f'<p class="pale">The table of all {len(result.names)} numbers is in fit.json.</p>'
    return f"<h2>Correlations</h2>{words}{_heat_map(result) if len(result.names) <= _MOST else too_many}"


def _heat_map(result: FitResult) -> str:
    count = len(result.names)
    kind = "many" if count > _MOST_TEXTS else "some" if count > 4 else "few"
    head = "".join(f'<th scope="col">{k + 1}</th>' for k in range(count))
    lines = []
    for i, name in enumerate(result.names):
        cells = "".join(_cell(float(value)) for value in result.correlations[i])
        lines.append(f'<tr><th scope="row">{i + 1} {escape(name)}</th>{cells}</tr>')
    caption = "Correlations of the errors: dark blue is −1, white 0, dark red 1." + (
        "" if np.isfinite(result.correlations).all() else " Empty: a number is not determined."
    )
    return (
        f'<div class="wide" tabindex="0" role="region" aria-label="Table of correlations"><table class="correlations {kind}">'
        f'<caption>{caption}</caption><colgroup><col class="names">{"<col>" * count}</colgroup>'
        f"<thead><tr><td></td>{head}</tr></thead><tbody>{''.join(lines)}</tbody></table></div>"
    )


def _cell(value: float) -> str:
    if not math.isfinite(value):
        return "<td>–</td>"
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    colour = colormaps[SIGNED](0.5 + 0.5 * value)
    # Black or white letters, whichever has the higher contrast (WCAG 2: relative luminance above 0.18).
    linear = [channel / 12.92 if channel <= 0.04045 else ((channel + 0.055) / 1.055) ** 2.4 for channel in colour[:3]]
    ink = "#000" if np.dot(linear, (0.2126, 0.7152, 0.0722)) > 0.18 else "#fff"
    return f'<td style="background:{to_hex(colour)};color:{ink}">{_signed(value)}</td>'


def _signed(value: float) -> str:
    """A correlation with two places, which is ±1 only if it is that much."""
    if 0.995 <= abs(value) < 1 - 1e-9:
        return f"{'−' if value < 0 else ''}{math.floor(abs(value) * 1000) / 1000:.3f}"
    return f"{value + 0.0:.2f}".replace("-0.00", "0.00").replace("-", "−")

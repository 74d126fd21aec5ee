"""Tables of the fits of the benchmark."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from shadowmap_dr.experiments.bench.fits.score import summary
from shadowmap_dr.io.console import markdown

from .records import Lines, record

_BAR_SECONDS = 60


def _problems() -> Mapping[str, Mapping[str, Any]]:
    problems: Mapping[str, Mapping[str, Any]] = record("fits")["sections"]["fits"]["units"]
    return problems


def fits() -> Lines:
    """A row for each problem."""
    rows = []
    for name, unit in _problems().items():
        runs = unit["starts"]
        seconds = [run["seconds"] for run in runs]
        worst = max((one["error"] / one["bar"] for run in runs if run["solved"] for one in run["deviations"]), default=np.nan)
        held = [holds(one) for run in runs if run["solved"] for one in run["intervals"]]
        rows.append(
            [
                name,
                ", ".join(f"`{part}`" for part in unit["vary"]),
                f"`{unit['integrator']}`",
                f"{sum(run['solved'] for run in runs)} of {len(runs)}",
                f"{np.median(seconds):.0f}",
                f"{max(seconds):.0f}",
                f"{100 * worst:.0f} %",
                f"{sum(held)} of {len(held)}",
            ]
        )
    return markdown(
        [
            "problem",
            "fitted",
            "pictures by",
            "solved",
            "median [s]",
            "longest [s]",
            "largest error over bar",
            "intervals that hold",
        ],
        rows,
    )


def fits_in_short() -> Lines:
    """All runs together."""
    runs = [run for unit in _problems().values() for run in unit["starts"]]
    total = summary(runs)
    seconds = np.array([run["seconds"] for run in runs])
    count = len(runs)
    rows = [
        ["solved", f"{total['solved']} of {count} ({100 * total['solved'] / count:.1f} %)", ">= 90 %"],
        ["called found, but not solved", f"{total['false_found']}", "0"],
        ["solved, but called not found", f"{total['missed']}", ""],
        ["seconds, median and longest", f"{np.median(seconds):.0f}, {seconds.max():.0f}", f"<= {_BAR_SECONDS}"],
        [f"runs within {_BAR_SECONDS} s", f"{np.count_nonzero(seconds <= _BAR_SECONDS)} of {count}", "all"],
        ["95 % intervals that hold the true value", f"{100 * total['coverage']:.1f} % of {total['intervals']}", "85 to 99 %"],
        ["half-width over error (medians)", f"{total['ratio']:.2g}", "<= 4"],
    ]
    return markdown(["all runs", "measured", "aim"], rows)


def holds(interval: Mapping[str, Any]) -> bool:
    """True if an interval holds the true value. JSON has no infinity, the half-width of numbers that a fit cannot know."""
    half = interval["half_width"]
    return half is None or abs(interval["value"] - interval["truth"]) <= half

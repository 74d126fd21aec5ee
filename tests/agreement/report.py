"""Table of errors, from their record."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: Largest mean errors that count as agreement, by mode.
TOLERANCES = {"primal": 0.02, "forward": 0.05, "reverse": 0.01}
COLUMNS = ["case", "primal", "largest", "forward", "largest", "reverse"]


def cells(name: str, errors: Mapping[str, Mapping[str, float]]) -> list[str]:
    """A row: mean errors (bold beyond the tolerances), and the largest of a pixel; in reverse mode there is one number."""
    row = [name]
    for mode, error in errors.items():
        text = f"{100 * error['mean']:.2f} %"
        row.append(text if error["mean"] <= TOLERANCES[mode] else f"**{text}**")
        row += [f"{100 * error['largest']:.0f} %"] if mode != "reverse" else []
    return row


def summary(cases: Mapping[str, Mapping[str, Mapping[str, float]]]) -> str:
    """A sentence: how many errors are within the tolerances."""
    within = [error["mean"] <= TOLERANCES[mode] for errors in cases.values() for mode, error in errors.items()]
    return f"{sum(within)} of {len(within)} within the tolerances."


def rows(record: Mapping[str, Any]) -> list[list[str]]:
    """All rows."""
    return [cells(name, errors) for name, errors in record["cases"].items()]

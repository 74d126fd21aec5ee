"""The table of Mitsuba's own tests."""

from __future__ import annotations

from shadowmap_dr.io.console import markdown
from tests.agreement import report

from .records import Lines, record


def agreement() -> Lines:
    """Mitsuba's own tests."""
    return markdown(report.COLUMNS, report.rows(record("agreement")))

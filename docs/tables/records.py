"""Records of docs/results."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from shadowmap_dr.io.records import read_json

DOCS = Path(__file__).resolve().parents[1]
RESULTS = DOCS / "results"

Lines = list[str]


def record(name: str) -> Any:
    """A record of docs/results."""
    return read_json(RESULTS / f"{name}.json")

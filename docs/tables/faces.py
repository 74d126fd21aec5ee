"""Tables of faces."""

from __future__ import annotations

from shadowmap_dr.experiments.faces import report as faces
from shadowmap_dr.io.console import markdown

from .records import Lines, record


def heads(mode: str) -> Lines:
    """Distances from all heads."""
    _, rows = faces.rows(record("faces"), mode)
    columns = ["head", "start, mean", "largest"]
    kept = list(range(9) if mode == "identity" else (0, 1, 2, 3, 4, 6, 7))
    for lights in ("1 shadow", "3 shadows"):
        columns += [f"{lights}, mean", "largest", *(["ms"] if mode == "identity" else [])]
    return markdown(columns, [[row[k] for k in kept] for row in rows])


def expressions(lights: int) -> Lines:
    """Expressions that can be seen."""
    text = faces._expressions(record("faces"), lights)
    return [line for line in text if line.startswith("|")]

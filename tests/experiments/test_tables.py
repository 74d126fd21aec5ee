"""Tables of commands at a width of 80 columns, drawn from the records in the documentation."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from rich.table import Table

from shadowmap_dr.experiments.bench import report as bench
from shadowmap_dr.experiments.faces import report as faces
from shadowmap_dr.experiments.gradients import convergence
from shadowmap_dr.experiments.gradients import report as gradients
from shadowmap_dr.experiments.lights import report as lights
from shadowmap_dr.experiments.maps import experiment as maps
from shadowmap_dr.experiments.pose import experiment as pose
from shadowmap_dr.experiments.soft import report as soft
from shadowmap_dr.io.console import fit

RESULTS = Path(__file__).resolve().parents[2] / "docs" / "results"


def record(name: str) -> Any:
    return json.loads((RESULTS / f"{name}.json").read_text())


def tables(name: str) -> Iterator[Table | None]:
    stored = record(name)
    if name == "bench":
        yield bench.table(stored)
    elif name == "faces":
        yield from faces.tables(stored)
    elif name == "lights":
        yield lights.table(stored["summaries"])
    elif name == "maps":
        yield from (maps.table(stored), maps.poses_table(stored))
    elif name == "maps-views":
        yield from maps.tables(stored)
    elif name == "soft":
        yield from (soft.table(stored), soft.times_table(stored))
    else:
        yield gradients.jacobian_table(stored["jacobian"])
        yield convergence.convergence_table(stored["convergence"])


def shown(table: Table) -> list[str]:
    console = Console(width=80, file=io.StringIO())
    fit(table, 80)
    console.print(table)
    return console.file.getvalue().splitlines()  # type: ignore[attr-defined]


def assert_whole(table: Table) -> None:
    """Every word of every cell stands in some line, and no line is cut."""
    lines = shown(table)
    text = " ".join(lines)
    assert max(map(len, lines)) <= 80 and "\u2026" not in text
    for column in table.columns:
        for cell in column.cells:
            assert all(word in text for word in str(cell).split()), cell


@pytest.mark.parametrize("name", ["bench", "faces", "gradients", "lights", "maps", "maps-views", "soft"])
def test_tables_are_whole_at_80_columns(name: str) -> None:
    found = [table for table in tables(name) if table is not None]
    assert found
    for table in found:
        assert_whole(table)


def test_the_table_of_poses_is_whole_at_80_columns() -> None:
    entry = {
        **{"object": "armadillo", "resolution": 1024, "method": "rasterizer", "shadow_only": True, "normals": "vertex"},
        **{"rotation_error_deg": 123.456, "translation_error_x100": 123.456, "seconds_per_iteration": 12.3456},
        **{"seconds_total": 12345.6, "recovered": False},
    }
    assert_whole(pose.table([entry] * 1000))


@pytest.mark.parametrize("name", ["faces", "lights", "maps", "soft"])
def test_rows_that_fit_take_one_line(name: str) -> None:
    for table in tables(name):
        if table is not None:
            titles = 2 if len(str(table.title)) > 79 else 1
            heads = len(shown(table)) - titles - table.row_count
            assert heads <= 4, shown(table)

"""Runs of the benchmark in tests, and what holds for all of them."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from bench_sizes import TINY
from rich.console import Console

from shadowmap_dr import __version__
from shadowmap_dr.experiments.bench import experiment as bench
from shadowmap_dr.experiments.bench import report as bench_report
from shadowmap_dr.experiments.bench.common import BenchOptions


def options(out: Path, *only: str, **changes: Any) -> BenchOptions:
    return BenchOptions(**{"out": out / "bench.json", "only": only, "sizes": TINY, "mitsuba_seconds": 1.0, **changes})


def run(chosen: BenchOptions) -> dict[str, Any]:
    record = bench.run_bench(chosen, console=Console(quiet=True))
    assert bench.failures(record, chosen.only) == []
    assert json.loads(chosen.out.read_text()) == record
    assert chosen.out.with_suffix(".png").stat().st_size > 1000
    assert not [name for name in os.listdir(chosen.out.parent) if name.startswith(".")]
    assert {"processor", "threads", "mitsuba", "drjit", "variant"} <= record["machine"].keys()
    assert record["shadowmap_dr"] == __version__ and record["settings"]["quick"] == chosen.quick
    assert bench_report.table(record).row_count == len(record["figures"]) > 0
    text = bench_report.markdown(record)
    assert text.count("\n| ") >= len(record["figures"])
    return record

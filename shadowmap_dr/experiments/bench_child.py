"""The process that `bench_common.run_child` starts: reads a task from the standard input, writes results, one a line."""

from __future__ import annotations

import importlib
import json
import sys
from typing import Any

import drjit as dr
import mitsuba as mi

from .. import report


def main() -> None:
    task = json.load(sys.stdin)
    mi.set_variant(task["variant"])
    dr.set_thread_count(task["threads"])
    module, name = task["function"].split(":")
    function = getattr(importlib.import_module(f"shadowmap_dr.experiments.{module}"), name)

    def emit(result: dict[str, Any]) -> None:
        print(json.dumps(report.plain(result), allow_nan=False), flush=True)

    emit(function(**task["arguments"], emit=emit))


if __name__ == "__main__":
    main()

"""Child process of `bench.common.run_child`: reads a task from standard input and writes results, each a line of JSON."""

from __future__ import annotations

import importlib
import json
import sys
from typing import Any

import drjit as dr
import mitsuba as mi

from ...io import records
from ...jit.memory import physical_memory


def main() -> None:
    task = json.load(sys.stdin)
    if not task["variant"].startswith("cuda"):  # CUDA reserves far more addresses than it uses
        _limit_memory()
    mi.set_variant(task["variant"])
    dr.set_thread_count(task["threads"])
    module, name = task["function"].split(":")
    function = getattr(importlib.import_module(f"shadowmap_dr.experiments.{module}"), name)

    def emit(result: dict[str, Any]) -> None:
        print(json.dumps(records.plain(result), allow_nan=False), flush=True)

    emit(function(**task["arguments"], emit=emit))


def _limit_memory() -> None:
    """Limit the memory of this process: without memory left, the system might end other processes."""
    try:
        import resource

        limit = int(0.75 * physical_memory())
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    except (ImportError, OSError, OverflowError, ValueError):
        pass  # not on this system


if __name__ == "__main__":
    main()

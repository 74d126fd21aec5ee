"""The process that tries cases one after the other. It reads them from its input, and writes a line when one begins or ends."""

from __future__ import annotations

import faulthandler
import gc
import json
import os
import resource
import signal
import sys
import tempfile
from pathlib import Path
from typing import Any, TextIO

#: Cases after which memory is given back.
_COLLECT_EVERY = 50


def main() -> None:
    """Try the cases, a JSON list of (kind, number, seed)."""
    lines = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    faulthandler.enable()
    if hasattr(signal, "SIGUSR1"):
        faulthandler.register(signal.SIGUSR1, chain=False)
    sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
    cases = json.loads(sys.stdin.read())
    _prepare()
    _write(lines, ready=True)
    for done, (kind, number, seed) in enumerate(cases):
        _write(lines, begin=number, kind=kind)
        _try(lines, kind, number, seed)
        if done % _COLLECT_EVERY == _COLLECT_EVERY - 1:
            _give_back()
    _write(lines, end=True)
    lines.flush()
    # Without the interpreter's end, which takes seconds with all that the cases have loaded.
    os._exit(0)


def _prepare() -> None:
    import quick_kernels  # noqa: F401  before Dr.Jit

    # isort: split
    import drjit as dr
    import mitsuba as mi

    dr.set_thread_count(2)
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)


def _try(lines: TextIO, kind: str, number: int, seed: int) -> None:
    import mitsuba as mi

    from .kinds import Case
    from .trial import outcome_of

    case, here = Case(kind, number, seed), os.getcwd()
    run = case.load()
    before = _most_megabytes()
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        os.chdir(folder)
        try:
            found = outcome_of(lambda: run(case.generator, Path(folder)))
        finally:
            os.chdir(here)
    if mi.variant() != "llvm_ad_rgb":
        mi.set_variant("llvm_ad_rgb")
    grown = _most_megabytes() - before
    _write(lines, case=number, outcome=found.kind, text=found.text, seconds=round(found.seconds, 3), megabytes=round(grown))


def _most_megabytes() -> float:
    unit = 1e6 if sys.platform == "darwin" else 1e3
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def _give_back() -> None:
    import drjit as dr

    gc.collect()
    dr.sync_thread()
    dr.flush_malloc_cache()


def _write(lines: TextIO, **values: Any) -> None:
    lines.write(json.dumps(values) + "\n")
    lines.flush()


if __name__ == "__main__":
    main()

"""Commands of the program, called in this process."""

from __future__ import annotations

import io
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout

from shadowmap_dr.cli import main

from .outcome import Refused, Wrong, check


def run_command(arguments: Sequence[str]) -> str:
    """Call the program as from a shell. Returns what it has printed. Raises Refused with its one line, Wrong for other ends."""
    out, error = io.StringIO(), io.StringIO()
    with _arguments(arguments), redirect_stdout(out), redirect_stderr(error):
        try:
            main.main()
        except SystemExit as ended:
            status = ended.code
        else:
            raise Wrong("the program has not ended itself")
    said = error.getvalue()
    asked = bool({"--verbose", "-v"} & set(arguments))  # for tracebacks of errors of one line, too
    traced = re.search(r"Traceback(?![^$]*\nshadowmap_dr\.errors\.\w+: )" if asked else "Traceback", said)
    check(traced is None and "RuntimeWarning" not in said, f"on standard error: {said[-500:]!r}")
    if status in (0, None):
        return out.getvalue()
    errors = [line for line in said.splitlines() if line.startswith("error:")]
    check(len(errors) == 1, f"exit status {status} with {len(errors)} lines of errors: {said[-500:]!r}")
    *_, last = (line for line in said.splitlines() if line and not re.match(r"Try 'shadowmap-dr .*--help' for help\.$", line))
    check(last == errors[0], f"lines after the error: {said[-500:]!r}")
    raise Refused(re.sub(r"^error: ", "", errors[0]))


@contextmanager
def _arguments(arguments: Sequence[str]) -> Iterator[None]:
    before, sys.argv = sys.argv, ["shadowmap-dr", *arguments]
    try:
        yield
    finally:
        sys.argv = before

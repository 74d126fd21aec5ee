"""Random input for the library and its commands.

    python -m tests.fuzz [--cases N] [--seed S] [--kind K] [--case N] [--out FILE.json]

Each case must end in a right result or in one line that says what is wrong; none in a traceback, a signal, or beyond its
budget of time and memory. Exit status 1 if one does.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
from pathlib import Path

from .kinds import KINDS, Case, spread
from .outcome import Outcome
from .report import Report, fault_line
from .runner import run_cases


def main() -> int:
    """Run the cases, and print a table."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.fuzz", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=int, default=2000, help="number of cases [2000]")
    parser.add_argument("--seed", type=int, default=0, help="seed of the run, 0 or more [0]")
    parser.add_argument("--kind", action="append", choices=KINDS, help="kind of cases; repeatable [all]")
    parser.add_argument("--case", type=int, help="run this case of the kind alone, and print what comes of it")
    parser.add_argument("--out", type=Path, metavar="FILE.json", help="write counts and faults")
    options = parser.parse_args()
    if options.seed < 0 or options.cases < 1 or (options.case is not None and (options.case < 0 or len(options.kind or ()) != 1)):
        parser.error("give a seed of 0 or more, 1 case or more, and with --case one --kind.")
    names = [name for name in options.kind or KINDS if not KINDS[name].needs or importlib.util.find_spec(KINDS[name].needs)]
    cases = spread(options.cases, options.seed, names)
    if options.case is not None:
        cases = [Case(options.kind[0], options.case, options.seed)]
    report = Report(len(cases))

    def on_done(case: Case, outcome: Outcome) -> None:
        report.add(case, outcome)
        if options.case is not None:
            print(f"{outcome.kind}: {outcome.text}")

    run_cases(cases, on_done, report.look, print_error if options.case is not None else None)
    print(report.table())
    for case, outcome in report.faults:
        print(fault_line(case, outcome))
    if options.out is not None:
        options.out.write_text(json.dumps(report.record(["python", "-m", "tests.fuzz", *sys.argv[1:]]), indent=1) + "\n")
    return 1 if report.faults else 0


def print_error(text: str) -> None:
    """Print the standard error of a process, without LLVM's lines about passes."""
    print("".join(line for line in text.splitlines(keepends=True) if not line.startswith("BISECT: ")), file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())

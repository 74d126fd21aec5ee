"""Prints how far the plug-in is from Mitsuba, as a table: ``python -m tests.agreement [NAME ...]`` in the repository's folder.

``--json FILE`` writes a record of it. ``--references`` renders the stored references anew instead (about a minute each on two
cores), ``--defaults`` measures with the plug-in's default options.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

import mitsuba as mi

from shadowmap_dr.io import machine, records

mi.set_variant("llvm_ad_rgb")

from . import measure, references, report  # noqa: E402
from .cases import BY_NAME, CASES  # noqa: E402


def main() -> None:
    """Print the table, or make references."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(BY_NAME))
    parser.add_argument("--references", action="store_true", help="render the references")
    parser.add_argument("--defaults", action="store_true", help="measure with default options")
    parser.add_argument("--json", type=Path, metavar="FILE", help="record to write")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.names if name not in BY_NAME]
    if unknown:
        parser.error(f"no case {unknown[0]!r}: choose from {', '.join(BY_NAME)}.")
    chosen = [case for case in CASES if not arguments.names or case.name in arguments.names]
    if arguments.references:
        for case in chosen:
            made = references.traced(case)
            made.save(references.path_of(case))
            print(f"{case.name}: slope {made.slope:.6g}, standard error {made.noise:.2g}", flush=True)
        return
    print(f"| {' | '.join(report.COLUMNS)} |\n|{'---|' * len(report.COLUMNS)}", flush=True)
    found: dict[str, dict[str, dict[str, float]]] = {}
    for case in chosen:
        errors = {mode: measure.error(case, mode, {} if arguments.defaults else None) for mode in measure.MODES}
        found[case.name] = {mode: dataclasses.asdict(error) for mode, error in errors.items()}
        print(f"| {' | '.join(report.cells(case.name, found[case.name]))} |", flush=True)
    print(f"\n{report.summary(found)}")
    if arguments.json:
        records.write_json(arguments.json, {**machine.header({"defaults": arguments.defaults}), "cases": found})


if __name__ == "__main__":
    main()

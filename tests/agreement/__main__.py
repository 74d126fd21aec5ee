"""Prints how far the plug-in is from Mitsuba, as a table: ``python -m tests.agreement [NAME ...]`` in the repository's folder.

``--references`` renders the stored references anew instead (about a minute each on two cores), ``--defaults`` measures with the
plug-in's default options.
"""

from __future__ import annotations

import argparse

import mitsuba as mi

mi.set_variant("llvm_ad_rgb")

from . import measure, references  # noqa: E402
from .cases import BY_NAME, CASES  # noqa: E402


def main() -> None:
    """Print the table, or make references."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(BY_NAME))
    parser.add_argument("--references", action="store_true", help="render the references")
    parser.add_argument("--defaults", action="store_true", help="measure with default options")
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
    print("| case | primal | largest | forward | largest | reverse |\n| --- | --- | --- | --- | --- | --- |", flush=True)
    within = 0
    for case in chosen:
        errors = {mode: measure.error(case, mode, {} if arguments.defaults else None) for mode in measure.MODES}
        passes = {mode: found.mean <= measure.TOLERANCES[mode] for mode, found in errors.items()}
        within += sum(passes.values())
        cells = []
        for mode, found in errors.items():
            text = f"{100 * found.mean:.2f} %"
            cells.append(text if passes[mode] else f"**{text}**")
            if mode != "reverse":
                cells.append(f"{100 * found.largest:.0f} %")
        print(f"| {case.name} | {' | '.join(cells)} |", flush=True)
    print(f"\n{within} of {len(chosen) * len(measure.MODES)} within the tolerances.")


if __name__ == "__main__":
    main()

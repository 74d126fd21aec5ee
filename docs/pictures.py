"""Plots of the documentation, drawn anew from the records in docs/results: ``python -m docs.pictures [NAME ...]``.

Images (of derivatives, shadows, heads) are not in the records: their commands write them, as the pages say.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from docs.tables import RESULTS, record
from shadowmap_dr.experiments.bench import plot as bench
from shadowmap_dr.experiments.gradients import convergence
from shadowmap_dr.experiments.lights import report as lights
from shadowmap_dr.experiments.pose import table as pose
from shadowmap_dr.experiments.pose.plot import plot_convergence


def poses(path: Path, case: str) -> None:
    """Draw the runs of a case of poses. Methods of which a run has no curve are left out."""
    curves: dict[tuple[str, int], dict[str, list[list[float]]]] = {}
    for row in pose.rows(pose.read([RESULTS / "pose.json"])):
        own = [run.get("rotation_error_curve") for run in row.runs.values()]
        if row.case == case and all(own):
            curves.setdefault((row.object, row.resolution), {})[row.method] = own
    plot_convergence(path, curves)


#: Name of a file in docs/results -> the function that writes it.
PICTURES: dict[str, Callable[[Path], None]] = {
    "bench.png": lambda path: bench.plot(path, record("bench")),
    "gradients-convergence.png": lambda path: convergence.plot_errors(path, record("gradients")["convergence"]),
    "lights.png": lambda path: lights.plot(path, record("lights")["summaries"]),
    **{f"pose-{case}.png": lambda path, case=case: poses(path, case) for case in pose.CASES},
}


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"pictures [all]: {', '.join(PICTURES)}")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder to write to")
    options = parser.parse_args()
    unknown = [name for name in options.names if name not in PICTURES]
    if unknown:
        parser.error(f"no picture {unknown[0]!r}: choose from {', '.join(PICTURES)}.")
    for name in options.names or PICTURES:
        PICTURES[name](options.out / name)
        print(options.out / name)


if __name__ == "__main__":
    main()

"""The table of the README."""

from __future__ import annotations

import numpy as np

from shadowmap_dr.experiments.pose import table as pose
from shadowmap_dr.io.console import markdown

from . import formats
from .poses import pose_row
from .records import DOCS, Lines, record


def _readme_poses(label: str, case: str, command: str) -> list[str]:
    ours, theirs = pose_row(case, "shadows"), pose_row(case, "mitsuba")
    turned, other = (float(np.median(row.errors(pose._ERRORS[0]))) for row in (ours, theirs))
    return [label, f"{ours.recovered()} found, {turned:.3f} degrees", f"{theirs.recovered()} found, {other:.3f}", command]


def readme() -> Lines:
    """Results in the README. Bounds of images and derivatives are those of the tests that the rows name."""
    units = record("bench")["sections"]["steps"]["units"]
    steps = " / ".join(
        formats.two_digits(1e3 * units[f"step-{size}"]["seconds"]["shadows"]["median"]) for size in (128, 512, 1024)
    )
    ratios = loop_ratios()
    mitsuba = formats.time(units["step-128"]["seconds"]["mitsuba"]["median"])
    return markdown(
        ["", "shadowmap_dr", "Mitsuba", "command"],
        [
            _readme_poses("Spot's pose, 128 x 128, ten starts", "vertex-normals", "`shadowmap-dr pose --runs 10`"),
            _readme_poses("the same, flat shading", "seen", "`shadowmap-dr pose --normals face --runs 10`"),
            ["a step, 128 / 512 / 1024 pixels, flat shading", f"{steps} ms", f"{mitsuba} at 128", "`shadowmap-dr bench`"],
            [
                "images with shadows beside path tracing",
                "within 1.5 % of the mean",
                "",
                "`python -m pytest tests/rendering/test_references.py`",
            ],
            [
                "derivatives beside differences, 174 parameters",
                "cosine 0.98, scale 0.97 to 1.03",
                "",
                "`python -m pytest tests/integrator/test_gradients.py`",
            ],
            [
                "fourteen loops of tutorials, name exchanged",
                f"a step {min(ratios):g} to {max(ratios):g} times as fast",
                "1",
                "`shadowmap-dr bench --only loops`",
            ],
        ],
    )


def loop_ratios() -> list[float]:
    """Ratios of the loops, from their table in performance.md: no record of them is kept."""
    text = (DOCS / "performance.md").read_text(encoding="utf-8").partition("\n## Loops\n")[2]
    lines = [line for line in text.partition("\n## ")[0].splitlines() if line.startswith("|")]
    column = [cell.strip() for cell in lines[0].strip("|").split("|")].index("ratio")
    return [float(line.strip("|").split("|")[column]) for line in lines[2:]]

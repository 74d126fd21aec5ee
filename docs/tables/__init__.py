"""Tables of the documentation, from the records in docs/results: ``python -m docs.tables`` writes them into the pages.

A table lies between the lines ``<!-- table: NAME -->`` and ``<!-- end of table -->``; NAME is one of `TABLES`. `FILES` are pages
that reports write as a whole. ``--check`` writes nothing, and names what it would change. Measurements without a record stand in
sections that say "No record is kept".
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

from shadowmap_dr.experiments.art import gallery
from shadowmap_dr.experiments.pose import table as pose

from . import (
    agreement,
    art,
    extended_lights,
    faces,
    fits,
    gradients,
    light_directions,
    modelling,
    poses,
    readme,
    shadow_maps,
    speed,
)
from .records import DOCS, RESULTS, Lines, record

REGION = re.compile(r"^<!-- table: (?P<name>[^\n]+) -->\n(?P<body>.*?)^<!-- end of table -->$", re.MULTILINE | re.DOTALL)

TABLES: dict[str, Callable[[], Lines]] = {
    "readme": readme.readme,
    "poses": poses.poses,
    "poses of Spot, smooth": lambda: poses.poses_of_spot("vertex"),
    "poses of Spot, flat": lambda: poses.poses_of_spot("face"),
    "poses beside Mitsuba's, flat": lambda: poses.poses_compared("face"),
    "poses beside Mitsuba's, smooth": lambda: poses.poses_compared("vertex"),
    "default shading": poses.default_shading,
    "poses of users' meshes": poses.foreign_meshes,
    "poses by Levenberg-Marquardt": poses.levenberg_marquardt,
    "speed": speed.speed,
    "figures": speed.figures,
    "steps on a GPU": speed.on_a_gpu,
    "memory": speed.memory,
    "shadow maps": shadow_maps.shadow_maps,
    "views of maps": shadow_maps.views,
    "poses by shadow maps": shadow_maps.poses_by_map,
    "methods": shadow_maps.methods,
    "extended lights": extended_lights.extended_lights,
    "extended lights in short": extended_lights.extended_lights_in_short,
    "brightness": extended_lights.brightness,
    "light directions": light_directions.light_directions,
    "light directions by filter": light_directions.light_directions_by_filter,
    "times of light directions": light_directions.light_times,
    "derivative images": gradients.derivative_images,
    "kinds of maps": gradients.candidates,
    "projective derivatives": gradients.projective,
    "displaced occluders": gradients.displaced,
    "displaced occluders by maps": gradients.displaced_by_map,
    "minimal plane": gradients.minimal_plane,
    "agreement": agreement.agreement,
    "heads, identity": lambda: faces.heads("identity"),
    "heads, both": lambda: faces.heads("both"),
    "heads, expression": lambda: faces.heads("expression"),
    "expressions, one shadow": lambda: faces.expressions(1),
    "expressions, three shadows": lambda: faces.expressions(3),
    "art": art.art,
    "holes": art.holes,
    "modelling": modelling.modelling,
    "fits": fits.fits,
    "fits in short": fits.fits_in_short,
}
#: Pages that are written as a whole, below docs/.
FILES: dict[str, Callable[[], str]] = {
    "results/art.md": lambda: "\n".join(gallery.document(record("art"))) + "\n",
    "results/pose-table.md": lambda: pose.document(pose.rows(pose.read([RESULTS / "pose.json"]))),
}


def pages() -> list[Path]:
    """Files that may have tables: the README, and all pages of the documentation."""
    return [DOCS.parent / "README.md", *sorted(DOCS.rglob("*.md"))]


def written(text: str) -> str:
    """A page with its tables made anew.

    Raises:
        KeyError: no table has the name.
    """

    def filled(region: re.Match[str]) -> str:
        return "\n".join([f"<!-- table: {region['name']} -->", *TABLES[region["name"]](), "<!-- end of table -->"])

    return REGION.sub(filled, text)


def outdated(paths: Iterable[Path]) -> dict[Path, str]:
    """The text of each page that is not what its records say."""
    result = {}
    for path in paths:
        text = path.read_text(encoding="utf-8")
        name = path.relative_to(DOCS).as_posix() if path.is_relative_to(DOCS) else path.name
        new = FILES[name]() if name in FILES else written(text)
        if new != text:
            result[path] = new
    return result


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 if a page would change")
    options = parser.parse_args()
    changed = outdated(pages())
    for path, text in changed.items():
        print(path.relative_to(DOCS.parent).as_posix())
        if not options.check:
            path.write_text(text, encoding="utf-8")
    sys.exit(1 if options.check and changed else 0)

"""Problems as folders: what the command gets, what was true, and a sheet of all photographs.

``python -m shadowmap_dr.experiments.bench.fits OUT [--only NAME]... [--start K] [--sheet]``
"""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

import mitsuba as mi
from PIL import Image, ImageDraw

from ....io import records
from . import catalogue
from .problem import FitProblem
from .targets import render, write_problem

_TILE = 300


def main() -> None:
    parser = argparse.ArgumentParser(description="Write problems for the fit as folders.")
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", action="append", default=[], help="name of a problem")
    parser.add_argument("--calibration", action="store_true", help="the problems for tuning instead of those that are scored")
    parser.add_argument("--start", type=int, default=0, help="number of the start values")
    parser.add_argument("--sheet", action="store_true", help="draw start and photograph of all problems side by side")
    arguments = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    every = catalogue.calibration() if arguments.calibration else catalogue.scored()
    problems = catalogue.named(arguments.only) if arguments.only else list(every)
    for problem in problems:
        folder = arguments.out / problem.name
        write_problem(problem, arguments.start, folder, arguments.out / "pictures")
        records.write_json(folder / "truth.json", problem.described())
        command = shlex.join(["fit", *problem.options(), "--out", "fit"])
        (folder / "command.txt").write_text(f"shadowmap-dr {command}\n", encoding="utf-8")
        print(problem.name, flush=True)
    if arguments.sheet:
        _sheet(problems, arguments.out)


def _sheet(problems: list[FitProblem], out: Path) -> None:
    """Pictures by the start values beside the photographs."""
    tiles = []
    for problem in problems:
        folder = out / problem.name
        starts = render(folder / "scene.xml", "direct", 16)
        for k, (photo, file) in enumerate(zip(problem.photographs, problem.targets(), strict=True)):
            pair = [Image.fromarray(photo.taken(starts[k], 0)), Image.open(folder / file)]
            tile = Image.new("RGB", (2 * _TILE, int(_TILE * pair[0].height / pair[0].width) + 14))
            for j, image in enumerate(pair):
                tile.paste(image.resize((_TILE - 2, tile.height - 14)), (j * _TILE, 14))
            ImageDraw.Draw(tile).text((2, 1), f"{problem.name} {' '.join(one.name for one in problem.varied)}", fill="white")
            tiles.append(tile)
    height, columns = max(tile.height for tile in tiles), 3
    sheet = Image.new("RGB", (columns * 2 * _TILE, -(-len(tiles) // columns) * height))
    for k, tile in enumerate(tiles):
        sheet.paste(tile, (k % columns * 2 * _TILE, k // columns * height))
    sheet.save(out / "sheet.png")


if __name__ == "__main__":
    main()

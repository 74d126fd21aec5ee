"""Share of starts from which the poses of foreign meshes are found, by the settings of the search.

    python -m shadowmap_dr.experiments.pose.foreign --out foreign [--runs 10] [--mesh NAME|FILE ...] [--setting auto|1|4|16 ...]

Makes the meshes of `foreign_meshes`, finds each from ten starts at 128 x 128, and writes OUT/foreign.json, OUT/foreign.md and a
picture of all. Settings: ``1``, ``4`` and ``16`` samples per pixel without blur and with one try, and ``auto``, the defaults for
files. Runs of an earlier call are kept.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...io import console, images, records
from ...io.files import atomic
from .foreign_meshes import MAKERS, write
from .methods import searching
from .record import identity, make_record
from .scene import make_problem, path_traced_reference
from .search import Search, choose, facet_widths, narrow_width

SETTINGS = ("1", "4", "16", "auto")


def measure(file: Path, setting: str, numbers: range, *, resolution: int, iterations: int, work: Path) -> dict[str, Any]:
    """Runs of the method `shadows` for a mesh file, by their numbers: settings, ends, and seconds of each run."""
    problem = make_problem(str(file), resolution, work=work / "objects")
    reference = path_traced_reference(problem, work / problem.folder / "reference.exr")
    search = choose(problem, str(file), None, None, None) if setting == "auto" else Search(int(setting))
    method = searching(search, iterations)("shadows", problem, reference)
    results = []
    for run in numbers:
        wanted = identity(problem, "shadows", run, method, seed=0, iterations=iterations, reference="mitsuba")
        record = make_record(method, reference, wanted, None, lambda *_: None)
        names = ("start", "final", "rotation_error_deg", "translation_error_x100", "found", "unexplained", "seconds_total")
        results.append({**{name: record[name] for name in names}, "tries": len(record["tries"])})
    return {
        "faces": int(len(facet_widths(problem))),
        "narrow_width": narrow_width(facet_widths(problem)),
        "search": dataclasses.asdict(search),
        "threads": dr.thread_count(),
        "runs": results,
    }


def table(found: dict[str, dict[str, Any]]) -> list[str]:
    """Lines of a Markdown table: a row for each mesh, and the sums."""
    settings = [setting for setting in SETTINGS if any(setting in entry for entry in found.values())]
    names = {"1": "1 sample", "4": "4", "16": "16", "auto": "default"}
    columns = ["mesh", "faces", "narrow [px]", *(f"{names[setting]}: found, s" for setting in settings), "samples", "tries"]
    rows = []
    for name, entry in found.items():
        first = next(iter(entry.values()))
        auto = entry.get("auto")
        rows.append(
            [
                name,
                str(first["faces"]),
                f"{first['narrow_width']:.2f}",
                *(_cell([entry[setting]] if setting in entry else []) for setting in settings),
                str(auto["search"]["samples"]) if auto else "",
                f"{np.mean([run['tries'] for run in auto['runs']]):.1f}" if auto else "",
            ]
        )
    total = (_cell([entry[setting] for entry in found.values() if setting in entry]) for setting in settings)
    rows.append([f"all {len(found)}", "", "", *total, "", ""])
    return console.markdown(columns, rows)


def sheet(folders: Sequence[Path], columns: int = 6) -> npt.NDArray[np.float32]:
    """The reference images in some folders, side by side in rows, linear colours."""
    tiles = [images.read_image(folder / "reference.exr") for folder in folders]
    tiles += [np.ones_like(tiles[0])] * (-len(tiles) % columns)
    return np.concatenate([np.concatenate(tiles[k : k + columns], 1) for k in range(0, len(tiles), columns)])


def _cell(entries: Sequence[dict[str, Any]]) -> str:
    """Runs found of runs made, and the median of their seconds."""
    runs = [run for entry in entries for run in entry["runs"]]
    if not runs:
        return ""
    return f"{sum(run['found'] for run in runs)}/{len(runs)}, {np.median([run['seconds_total'] for run in runs]):.1f}"


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m shadowmap_dr.experiments.pose.foreign", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("--out", type=Path, default=Path("foreign"), help="folder of meshes, references and results")
    parser.add_argument("--runs", type=int, default=10, help="starts")
    parser.add_argument("--resolution", type=int, default=128, help="image width and height in pixels")
    parser.add_argument("--iterations", type=int, default=150, help="steps of a descent")
    parser.add_argument("--mesh", action="append", metavar="NAME|FILE", help=f"mesh file, or one of {', '.join(MAKERS)}")
    parser.add_argument("--setting", action="append", choices=SETTINGS, help="settings of the search [all]")
    parser.add_argument("--threads", type=int, default=0, help="threads, 0 for one for each core")
    options = parser.parse_args(arguments)
    mi.set_variant("llvm_ad_rgb")
    if options.threads:
        dr.set_thread_count(options.threads)
    path = options.out / "foreign.json"
    found: dict[str, dict[str, Any]] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    for setting in options.setting or SETTINGS:
        for name in options.mesh or MAKERS:
            file = write(name, options.out / "meshes") if name in MAKERS else Path(name).resolve()
            entry = found.setdefault(file.stem, {})
            kept = entry.get(setting, {}).get("runs", [])
            missing = range(len(kept), options.runs)
            if not missing:
                continue
            sizes = {"resolution": options.resolution, "iterations": options.iterations}
            entry[setting] = measure(file, setting, missing, **sizes, work=options.out)
            entry[setting]["runs"] = kept + entry[setting]["runs"]
            found = dict(sorted(found.items()))
            records.write_json(path, found)
            with atomic(options.out / "foreign.md") as temporary:
                temporary.write_text("\n".join(table(found)) + "\n", encoding="utf-8")
            print(f"{file.stem}, {setting}: {_cell([entry[setting]])} s a run", flush=True)
    folders = [options.out / f"{name}-{options.resolution}" for name in found]
    images.write_png(options.out / "foreign.png", sheet([folder for folder in folders if folder.is_dir()]))
    print("\n".join(table(found)))


if __name__ == "__main__":
    main()

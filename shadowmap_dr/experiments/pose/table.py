"""The table of recovered poses: all records of the pose experiment, compared with Mitsuba's from the same starts.

``python -m shadowmap_dr.experiments.pose.table FOLDER... --out docs/results`` reads the `pose.json` of each folder and writes
`pose.json` (all rows, compact), `pose-table.md` (the same for readers) and plots of the convergence `pose-*.png`. A FOLDER may
hold an earlier table: its runs are kept unless folders named after it have them, too.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...io import files
from ...io import records as io_records
from ...io.console import markdown
from .plot import plot_convergence
from .record import essence, is_number, runs_in

#: Largest excess of a median of ours over Mitsuba's: degrees, and 100 x offset.
ALLOWED_DEG, ALLOWED_X100 = 0.05, 0.05
METHODS = ("shadows", "rasterizer", "mitsuba")
#: Cases of the table: records with these values belong to the case.
CASES: dict[str, dict[str, Any]] = {
    "seen": {"shadow_only": False, "reference": "mitsuba", "normals": "face", "samples_per_pixel": 1},
    "four-samples": {"shadow_only": False, "reference": "mitsuba", "normals": "face", "samples_per_pixel": 4},
    "own-reference": {"shadow_only": False, "reference": "own", "normals": "face", "samples_per_pixel": 1},
    "shadow-only": {"shadow_only": True, "reference": "mitsuba", "normals": "face", "samples_per_pixel": 1},
    "vertex-normals": {"shadow_only": False, "reference": "mitsuba", "normals": "vertex", "samples_per_pixel": 1},
    "vertex-normals-four-samples": {"shadow_only": False, "reference": "mitsuba", "normals": "vertex", "samples_per_pixel": 4},
}
TITLES = {
    "seen": "Object and shadow in view, path-traced reference",
    "four-samples": "The same, our own methods with four samples per pixel",
    "own-reference": "One sample per pixel, reference image by our own renderer",
    "shadow-only": "Object out of view, path-traced reference",
    "vertex-normals": "Object and shadow in view, path-traced reference, smooth shading (vertex normals)",
    "vertex-normals-four-samples": "The same, our own methods with four samples per pixel",
}
#: Columns of the summary: case, method.
_SUMMARY = {
    "with shadows": ("seen", "shadows"),
    "the same, 4 samples": ("four-samples", "shadows"),
    "without shadows": ("seen", "rasterizer"),
    "Mitsuba": ("seen", "mitsuba"),
    "with shadows, own reference": ("own-reference", "shadows"),
    "with shadows, object out of view": ("shadow-only", "shadows"),
}
_ERRORS = ("rotation_error_deg", "translation_error_x100")
_CURVE = "rotation_error_curve"
_PER_RUN = ("seed", "run", "start", "final", *_ERRORS, "recovered")
_SETTINGS = ("seed", "iterations", "settings")
#: Significant digits of the errors along a run: only plots need them, and they make up most of the file.
_CURVE_DIGITS = 3


@dataclass
class Row:
    """The runs of a method on an object at a resolution, by (seed, run). `seconds`: per step, None if not timed alone."""

    case: str
    object: str
    resolution: int
    method: str
    runs: dict[tuple[int, int], dict[str, Any]] = field(default_factory=dict)
    seconds: float | None = None

    def errors(self, key: str, starts: Iterable[tuple[int, int]] | None = None) -> npt.NDArray[np.float64]:
        """Final errors of all runs, or of the runs from the given starts; infinite where a run failed."""
        runs = self.runs.values() if starts is None else [self.runs[start] for start in starts]
        return np.array([np.inf if record[key] is None else record[key] for record in runs], np.float64)

    def recovered(self, starts: Iterable[tuple[int, int]] | None = None) -> int:
        return sum(self.runs[start]["recovered"] for start in (self.runs if starts is None else starts))

    def plain(self) -> dict[str, Any]:
        """JSON values for the file: settings, runs, means, medians and recovered runs."""
        records = list(self.runs.values())
        environment = {key: value for key, value in records[0]["environment"].items() if key != "load_average"}
        return {
            "case": self.case, "object": self.object, "resolution": self.resolution, "method": self.method,
            **CASES[self.case], **{key: records[0][key] for key in _SETTINGS}, "environment": environment,
            "runs": {
                **{key: [record[key] for record in records] for key in _PER_RUN},
                _CURVE: [_rounded(record.get(_CURVE)) for record in records],
            },
            "mean": {key: float(np.mean(self.errors(key))) for key in _ERRORS},
            "median": {key: float(np.median(self.errors(key))) for key in _ERRORS},
            "recovered": self.recovered(), "share_recovered": self.recovered() / len(records),
            "seconds_per_step": self.seconds,
        }  # fmt: skip


def _rounded(curve: Sequence[float | None] | None) -> list[float | None] | None:
    """A curve to a few significant digits. A curve or entries that are None remain None."""
    return None if curve is None else [None if value is None else float(f"{value:.{_CURVE_DIGITS}g}") for value in curve]


def _records(row: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Records from the output of `Row.plain`."""
    names = (*CASES["seen"], *_SETTINGS, "environment", "object", "resolution", "method", "seconds_per_step")
    shared = {name: row[name] for name in names}
    runs = row["runs"]
    return [{**shared, **dict(zip(runs, values, strict=True))} for values in zip(*runs.values(), strict=True)]


def rows(records: Iterable[Mapping[str, Any]], timed: Iterable[Mapping[str, Any]] = ()) -> list[Row]:
    """Records grouped and sorted by case, object, resolution and method. Of two records of the same run the later one counts.

    Args:
        records: of the pose experiment; records that belong to none of `CASES` are left out.
        timed: records whose times were taken while nothing else ran; only their times count.

    Raises:
        ShadowmapError: runs of one row were made with different settings.
    """
    result: dict[tuple[Any, ...], Row] = {}
    for record in records:
        key = _row_key(record)
        if key is not None:
            row = result.setdefault(key, Row(*key))
            row.runs[record["seed"], record["run"]] = dict(record)
    seconds: dict[tuple[Any, ...], list[float]] = {}
    for record in timed:
        name = "seconds_per_iteration" if "seconds_per_iteration" in record else "seconds_per_step"  # of a run; of a table's row
        if record[name] is not None:
            seconds.setdefault(_row_key(record) or (), []).append(record[name])
    for key, row in result.items():
        row.runs = dict(sorted(row.runs.items()))
        first = next(iter(row.runs.values()))
        for (_, run), record in row.runs.items():
            if _made_with(record) != _made_with(first):
                which = f"runs {first['run']} and {run} of {row.method} for {row.object} at {row.resolution}"
                raise ShadowmapError(f"{which} were made with different settings: run one of them again.")
        row.seconds = float(np.median(seconds[key])) if key in seconds else first.get("seconds_per_step")
    cases = list(CASES)
    return sorted(result.values(), key=lambda row: (cases.index(row.case), row.object, row.resolution, METHODS.index(row.method)))


def _made_with(record: Mapping[str, Any]) -> list[Any]:
    return [record["environment"].get("variant"), *(essence(record[name]) for name in _SETTINGS[1:])]


def _row_key(record: Mapping[str, Any]) -> tuple[str, str, int, str] | None:
    values = {"normals": "face", **record}  # records of earlier versions lack the entry
    values["samples_per_pixel"] = record["settings"].get("samples_per_pixel", 1)
    for case, wanted in CASES.items():
        if all(values[name] == value for name, value in wanted.items()):
            return case, record["object"], record["resolution"], record["method"]
    return None


def comparison(table: Sequence[Row]) -> list[dict[str, Any]]:
    """Ours with shadows against Mitsuba's for each case, object and resolution, over their common starts.

    Differences are those of medians, ours less Mitsuba's (degrees, 100 x offset). `met`: neither is above the allowed excess,
    and ours recovers no fewer runs.
    """
    pairs = [(ours, theirs) for ours in table for theirs in table if ours.method == "shadows" and theirs.method == "mitsuba"]
    result = []
    for ours, theirs in pairs:
        same = {**CASES[ours.case], "samples_per_pixel": 1} == CASES[theirs.case]  # the samples are those of our own methods
        if not same or (ours.object, ours.resolution) != (theirs.object, theirs.resolution):
            continue
        starts = [key for key in theirs.runs if key in ours.runs and theirs.runs[key]["start"] == ours.runs[key]["start"]]
        if not starts:
            continue
        medians = {key: [float(np.median(row.errors(key, starts))) for row in (ours, theirs)] for key in _ERRORS}
        less = {key: pair[0] - pair[1] for key, pair in medians.items()}
        found = [ours.recovered(starts), theirs.recovered(starts)]
        result.append({
            "case": ours.case, "object": theirs.object, "resolution": theirs.resolution,
            "starts": [run for _, run in starts], "medians_ours_and_mitsuba": medians, "ours_less_mitsuba": less,
            "recovered_ours_and_mitsuba": found,
            "met": less[_ERRORS[0]] <= ALLOWED_DEG and less[_ERRORS[1]] <= ALLOWED_X100 and found[0] >= found[1],
        })  # fmt: skip
    return result


def document(table: Sequence[Row]) -> str:
    """The document in Markdown: a summary, the comparison with Mitsuba, then a table for each case."""
    lines = [
        "# Poses found",
        "",
        "## Runs recovered: median rotation error [degrees], median 100 x offset error",
        "",
        *_summary(table),
        "",
    ]
    compared = comparison(table)
    if compared:
        lines += ["## With shadows and by Mitsuba, from the same starts", "", *_compared(compared), ""]
    for case, title in TITLES.items():
        own = [row for row in table if row.case == case]
        if own:
            lines += [f"## {title}", "", *_cells(own), ""]
    return "\n".join(lines)


def _summary(table: Sequence[Row]) -> list[str]:
    by_key = {(row.object, row.resolution, row.case, row.method): row for row in table}

    def cell(key: tuple[str, int, str, str]) -> str:
        if key not in by_key:
            return ""
        row = by_key[key]
        medians = ", ".join(f"{np.median(row.errors(name)):.3f}" for name in _ERRORS)
        return f"{row.recovered()}/{len(row.runs)}: {medians}"

    problems = sorted({key[:2] for key in by_key})
    return markdown(
        ["object", "pixels", *_SUMMARY],
        (
            [name, str(resolution), *(cell((name, resolution, *column)) for column in _SUMMARY.values())]
            for name, resolution in problems
        ),
    )


def _compared(entries: Sequence[Mapping[str, Any]]) -> list[str]:
    columns = [
        "normals",
        "our samples",
        "object",
        "pixels",
        "starts",
        "recovered: ours, Mitsuba",
        "median rotation [deg]: ours, Mitsuba",
        "median 100 x offset: ours, Mitsuba",
        "aim",
    ]
    return markdown(
        columns,
        (
            [
                *(str(CASES[entry["case"]][key]) for key in ("normals", "samples_per_pixel")),
                entry["object"],
                str(entry["resolution"]),
                str(len(entry["starts"])),
                ", ".join(map(str, entry["recovered_ours_and_mitsuba"])),
                *(", ".join(f"{value:.3f}" for value in entry["medians_ours_and_mitsuba"][key]) for key in _ERRORS),
                "yes" if entry["met"] else "NO",
            ]
            for entry in entries
        ),
    )


def _cells(table: Sequence[Row]) -> list[str]:
    columns = [
        "object",
        "pixels",
        "method",
        "recovered",
        "rotation [deg]: mean",
        "median",
        "100 x offset: mean",
        "median",
        "s a step",
    ]
    return markdown(
        columns,
        (
            [
                row.object,
                str(row.resolution),
                row.method,
                f"{row.recovered()} of {len(row.runs)}",
                *(f"{value:.3f}" for key in _ERRORS for value in (np.mean(row.errors(key)), np.median(row.errors(key)))),
                "" if row.seconds is None else f"{row.seconds:.2g}",
            ]
            for row in table
        ),
    )


def read(folders: Iterable[str | Path]) -> list[dict[str, Any]]:
    """The records of all folders (or files), in order. A file may be an earlier table (`write`).

    Raises:
        ShadowmapError: a file is missing, or is neither a list of records nor a table.
    """
    result: list[dict[str, Any]] = []
    for folder in map(Path, folders):
        path = folder / "pose.json" if folder.is_dir() else folder
        records = io_records.read_json(path)
        if isinstance(records, dict) and "rows" in records:
            try:
                found = [record for row in records["rows"] for record in _records(row)]
            except (KeyError, TypeError, ValueError, AttributeError) as error:
                raise ShadowmapError(f"{path} is no table of the pose experiment ({error!r}).") from error
            if not all(_is_sound(record) for record in found):
                raise ShadowmapError(f"{path} is no table of the pose experiment: it was edited, or is damaged; make it again.")
            result += found
            continue
        records = runs_in(records)
        if records is None or not all(isinstance(entry, dict) and _is_sound(entry) for entry in records):
            raise ShadowmapError(f"{path} is no list of records of the pose experiment.")
        result += records
    return result


def _is_sound(record: dict[str, Any]) -> bool:
    """True if the entries that tables are made of have the right types."""
    types: dict[type, tuple[str, ...]] = {
        str: ("object", "method", "reference"),
        int: ("resolution", "seed", "run", "iterations"),
        bool: ("recovered", "shadow_only"),
        dict: ("settings", "environment"),
        list: ("start", "final"),
    }
    if not all(type(record.get(name)) is kind for kind, names in types.items() for name in names):
        return False
    curve, errors = record.get(_CURVE), [record.get(name, "") for name in _ERRORS]
    times = [record.get(name) for name in ("seconds_per_iteration", "seconds_per_step")]
    return (
        record["method"] in METHODS
        and record.get("normals", "face") in ("face", "vertex")
        and all(map(is_number, [*errors, *times]))
        and (curve is None or (isinstance(curve, list) and all(map(is_number, curve))))
    )


def write(out: Path, records: Sequence[Mapping[str, Any]], timed: Sequence[Mapping[str, Any]] = ()) -> list[Row]:
    """Write `pose.json`, `pose-table.md` and plots into the folder `out`; returns the rows.

    Cases with a run without a curve (in tables of earlier versions) get no plot; an existing plot in `out` is kept.
    """
    table = rows(records, timed)
    files.check_output(out / "pose.json", (".json",))
    io_records.write_json(out / "pose.json", {"rows": [row.plain() for row in table], "comparison": comparison(table)})
    with files.atomic(out / "pose-table.md") as temporary:
        temporary.write_text(document(table), encoding="utf-8")
    for case in dict.fromkeys(row.case for row in table):
        if not all(record.get(_CURVE) for row in table if row.case == case for record in row.runs.values()):
            continue
        curves: dict[tuple[str, int], dict[str, list[list[float]]]] = {}
        for row in table:
            if row.case == case:
                panel = curves.setdefault((row.object, row.resolution), {})
                panel[row.method] = [record[_CURVE] for record in row.runs.values()]
        plot_convergence(out / f"pose-{case}.png", curves)
    return table


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m shadowmap_dr.experiments.pose.table", description=__doc__.split("\n")[0])
    parser.add_argument("folders", nargs="+", metavar="FOLDER", help="results of the pose experiment; some runs may be missing")
    parser.add_argument("--timed", nargs="*", default=[], metavar="FOLDER", help="results whose times were taken alone")
    parser.add_argument("--out", type=Path, default=Path("docs/results"), help="folder to write to")
    options = parser.parse_args()
    try:
        table = write(options.out, read(options.folders), read(options.timed))
    except ShadowmapError as error:
        sys.exit(f"error: {error}")
    print(document(table))


if __name__ == "__main__":
    main()

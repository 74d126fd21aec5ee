"""Tables of the documentation, from the records in docs/results: ``python -m docs.tables`` writes them into the pages.

A table lies between the lines ``<!-- table: NAME -->`` and ``<!-- end of table -->``; NAME is one of `TABLES`. `FILES` are pages
that reports write as a whole. ``--check`` writes nothing, and names what it would change. Measurements without a record stand in
sections that say "No record is kept".
"""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from shadowmap_dr.experiments.art import gallery
from shadowmap_dr.experiments.bench import report as bench
from shadowmap_dr.experiments.faces import report as faces
from shadowmap_dr.experiments.gradients import convergence
from shadowmap_dr.experiments.gradients import report as jacobian
from shadowmap_dr.experiments.pose import foreign
from shadowmap_dr.experiments.pose import table as pose
from shadowmap_dr.experiments.soft import report as soft
from shadowmap_dr.io.console import markdown
from shadowmap_dr.io.records import read_json
from tests.agreement import report

DOCS = Path(__file__).resolve().parent
RESULTS = DOCS / "results"
REGION = re.compile(r"^<!-- table: (?P<name>[^\n]+) -->\n(?P<body>.*?)^<!-- end of table -->$", re.MULTILINE | re.DOTALL)

Lines = list[str]


def record(name: str) -> Any:
    """A record of docs/results."""
    return read_json(RESULTS / f"{name}.json")


def pages() -> list[Path]:
    """Files that may have tables: the README, and all pages of the documentation."""
    return [DOCS.parent / "README.md", *sorted(DOCS.rglob("*.md"))]


# Poses.


def poses() -> Lines:
    """Runs recovered and median errors."""
    return pose._summary(pose.rows(pose.read([RESULTS / "pose.json"])))


def poses_compared(normals: str) -> Lines:
    """Ours beside Mitsuba's, from the same starts."""
    entries = pose.comparison(pose.rows(pose.read([RESULTS / "pose.json"])))
    return pose._compared([entry for entry in entries if pose.CASES[entry["case"]]["normals"] == normals])


#: Labels of Spot's rows by normals, case and method.
_SPOT = {
    "vertex": {
        ("vertex-normals", "shadows"): "with shadows",
        ("vertex-normals", "rasterizer"): "without shadows",
        ("vertex-normals", "mitsuba"): "Mitsuba's projective integrator",
    },
    "face": {
        ("seen", "shadows"): "with shadows",
        ("seen", "rasterizer"): "without shadows",
        ("seen", "mitsuba"): "Mitsuba's projective integrator",
        ("shadow-only", "shadows"): "with shadows, object out of view",
        ("shadow-only", "rasterizer"): "without shadows, object out of view",
    },
}


def poses_of_spot(normals: str) -> Lines:
    """Spot at 128 x 128 with smooth (`vertex`) or flat (`face`) shading: the short table."""
    rows = []
    for (case, method), label in _SPOT[normals].items():
        row = _pose_row(case, method)
        found = f"{row.recovered()} of {len(row.runs)}"
        if label == "without shadows, object out of view":
            found += " (gradient exactly zero)"
        turned, offset = (f"{np.mean(values):.3f}{{}} ({np.median(values):.3f})" for values in map(row.errors, pose._ERRORS))
        flat = " --normals face" * (normals == "face")
        command = f"shadowmap-dr pose{flat} --runs {len(row.runs)} --method {method}{' --shadow-only' * (case == 'shadow-only')}"
        rows.append([label, found, turned.format(" deg"), offset.format(""), f"`{command}`"])
    return markdown(
        [{"vertex": "smooth shading", "face": "flat shading"}[normals], "recovered", "rotation", "100 x offset", "command"], rows
    )


def _pose_row(case: str, method: str) -> pose.Row:
    """Spot at 128 x 128."""
    table = pose.rows(pose.read([RESULTS / "pose.json"]))
    (row,) = (row for row in table if (row.case, row.object, row.resolution, row.method) == (case, "spot", 128, method))
    return row


def default_shading() -> Lines:
    """Mitsuba's counts of samples and results with smooth and flat shading, beside ours."""
    rows = []
    for normals, case in (("vertex", "vertex-normals"), ("face", "seen")):
        both = [_pose_row(case, method) for method in ("mitsuba", "shadows")]
        (stored,) = (
            row
            for row in record("pose")["rows"]
            if (row["case"], row["object"], row["resolution"], row["method"]) == (case, "spot", 128, "mitsuba")
        )
        counts = "/".join(str(stored["settings"][key]) for key in ("sppc", "sppp", "sppi"))
        turned = ", ".join(f"{np.median(row.errors(pose._ERRORS[0])):.3f}" for row in both)
        rows.append([f"`--normals {normals}`", counts, ", ".join(str(row.recovered()) for row in both), turned])
    return markdown(
        ["Spot, 128 x 128, ten starts", "Mitsuba's samples", "found: Mitsuba, ours", "median rotation [deg]: Mitsuba, ours"], rows
    )


def foreign_meshes() -> Lines:
    """Meshes of users."""
    return foreign.table(record("pose-foreign"))


# Speed.


def figures() -> Lines:
    """All figures of the benchmark."""
    return markdown(bench.COLUMNS, [row.cells() for row in bench.rows(record("bench"))])


def speed() -> Lines:
    """Steps, and times to a pose."""
    units = record("bench")["sections"]["steps"]["units"]
    rows = []
    for size in (128, 512, 1024):
        step, found = units[f"step-{size}"], units[f"pose-{size}"]
        ours, none, mitsuba = (step["seconds"][name]["median"] for name in ("shadows", "rasterizer", "mitsuba"))
        setting = "fair setting" if step["mitsuba"]["fair"] else "too few samples to converge"
        own, theirs = found["methods"]["shadows"], found["methods"]["mitsuba"]
        never = "not within 300 s" if theirs["median_seconds_to_pose"] is None else _time(theirs["median_seconds_to_pose"])
        if size == 128:
            never += f" ({theirs['starts']} starts; ten: above)"
        rows.append(
            [
                f"{size} x {size}",
                _time(ours),
                _time(none),
                f"{_time(mitsuba)}, {setting}",
                f"{step['ratio_of_medians']['mitsuba / shadows']:.0f}x",
                f"{_two_digits(own['median_seconds_to_pose'])} s ({own['reached']} of {own['starts']})",
                never,
            ]
        )
    return markdown(
        [
            *("pixels", "step with shadows", "without", "Mitsuba's projective integrator", "ratio"),
            *("pose found (10 starts)", "by Mitsuba"),
        ],
        rows,
    )


def _readme_poses(label: str, case: str, command: str) -> list[str]:
    ours, theirs = _pose_row(case, "shadows"), _pose_row(case, "mitsuba")
    turned, other = (float(np.median(row.errors(pose._ERRORS[0]))) for row in (ours, theirs))
    return [label, f"{ours.recovered()} found, {turned:.3f} degrees", f"{theirs.recovered()} found, {other:.3f}", command]


def readme() -> Lines:
    """Results in the README. Bounds of images and derivatives are those of the tests that the rows name."""
    units = record("bench")["sections"]["steps"]["units"]
    steps = " / ".join(_two_digits(1e3 * units[f"step-{size}"]["seconds"]["shadows"]["median"]) for size in (128, 512, 1024))
    ratios = loop_ratios()
    mitsuba = _time(units["step-128"]["seconds"]["mitsuba"]["median"])
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


def on_a_gpu() -> Lines:
    """Steps on a GPU. Times of the paper are quoted."""
    paper = {128: 14, 512: 23, 1024: 46}
    rows = [
        [str(size), *(f"{record('cuda/h100')['steps'][str(size)][name]:.{digits}f} ms" for name, digits in _GPU), f"{quoted} ms"]
        for size, quoted in paper.items()
    ]
    names = ["pixels a side", "ours", "without shadows", "Mitsuba's `direct_projective`, fair setting", "Worchel and Alexa's"]
    return markdown(names, rows)


_GPU = (("shadows", 2), ("rasterizer", 2), ("mitsuba", 1))


def memory() -> Lines:
    """Memory of steps, and the bytes by which `rendering.light_slices` plans."""
    units = record("bench")["sections"]["scaling"]["units"]

    def peak(kind: str, size: int) -> str:
        (point,) = (point for point in units[kind]["points"] if point["size"] == size)
        return f"{point['peak_memory'] / 2**30:.2f} GiB"

    rows = [
        ["shadow maps with derivatives", "130 bytes for each texel"],
        ["vertices and their triangles, for each light", "222 bytes for each vertex"],
        ["a step of the pose scene at 512 x 512", f"{peak('resolution', 512**2)} (whole process)"],
        ["the same at 2048 x 2048", peak("resolution", 2048**2)],
        ["1.5 million triangles", peak("triangles", 1_499_138)],
    ]
    return markdown(["What", "How much"], rows)


# Shadow maps.

_MAPS = ("rmse", "rmse_shadowed", "bleeding", "acne", "contour_shift_texels", "derivative_cosine", "derivative_scale")


def shadow_maps() -> Lines:
    """All methods on all scenes."""
    digits = (4, 3, 4, 4, 3, 3, 3)
    rows = [
        [
            *(scene, method),
            *(_number(e[key], n) for key, n in zip(_MAPS, digits, strict=True)),
            f"{e['seconds_over_plain_vsm']:.2f}",
        ]
        for scene, entries in record("maps")["scenes"].items()
        for method, e in entries.items()
    ]
    return markdown(["scene", "method", "RMSE", "in shadow", "bleeding", "acne", "shift", "cosine", "scale", "time"], rows)


def poses_by_map() -> Lines:
    """Poses found with all methods."""
    rows = [
        [name, f"{e['found']} of {e['runs']}", f"{e['median_rotation_deg']:.3f} deg", f"{e['median_offset_x100']:.3f}"]
        for name, e in record("maps")["poses"].items()
    ]
    return markdown(["method", "found", "rotation", "100 x offset"], rows)


def methods() -> Lines:
    """The choice of a method."""
    scenes = record("maps")["scenes"]
    stored = {"vsm": 2, "esm": 1, "evsm2": 2, "evsm4": 4, "msm": 4, "csm": 16, "pcf": 3}
    rows = [
        [
            f"`{name}`" + ", `shadow_order` 8" * (name == "csm"),
            str(numbers),
            f"{scenes['tiers'][name]['bleeding']:.4f}",
            f"{scenes['sheet'][name]['rmse']:.4f}",
            f"{scenes['tiers'][name]['seconds_over_plain_vsm']:.2f}",
        ]
        for name, numbers in stored.items()
    ]
    return markdown(["method", "numbers a texel", "bleeding, `tiers`", "RMSE, `sheet`", "time, `tiers`"], rows)


# Area lights and skies.


def extended_lights() -> Lines:
    """All scenes."""
    return markdown(*soft.rows(record("soft")))


def extended_lights_in_short() -> Lines:
    """Errors of some scenes."""
    labels = {
        "desk": "a lamp over a desk",
        "lantern": "a shining ball in the middle of a scene",
        "overcast": "overcast sky",
        "sunny": "sky with a small, bright sun",
    }
    found = record("soft")
    columns = [f"{a} / {b}" for a, b in found["settings"]["samples"]]
    rows = [
        [label, *(f"{100 * error['error']:.1f} %" for error in found["scenes"][name]["errors"])] for name, label in labels.items()
    ]
    return markdown(["scene", *columns], rows)


def brightness() -> Lines:
    """Lamps without shadows: the largest deviation of all distances."""
    rows = []
    for name, entries in record("lamp_brightness")["lamps"].items():
        bias = max((entry["bias"] for entry in entries.values()), key=abs)
        rows.append([name, f"{100 * bias:+.1f} %", f"{100 * max(entry['error'] for entry in entries.values()):.1f} %"])
    return markdown(["lamp", "bias", "error"], rows)


# Directions of lights.


def light_directions() -> Lines:
    """Alignment for all settings."""
    rows = [
        [
            *(str(entry["lights"]), _filter(entry)),
            f"{entry['alignment_mean']:.4f}",
            f"{entry['alignment_std']:.3f}",
            f"{entry['alignment_least']:.3f}",
            f"{100 * entry['share_from_0.995']:.1f} %",
        ]
        for entry in record("lights")["summaries"]
    ]
    return markdown(["n", "shadows", "alignment", "deviation", "least", "at least 0.995"], rows)


def _filter(entry: Mapping[str, Any]) -> str:
    name = {"gaussian": "Gaussian", "wendland": "Wendland"}.get(entry["filter"], entry["filter"])
    size = entry["filter_size"]
    parts = [{0: "none", 1: "unfiltered"}.get(size, f"{name} {size}")]
    parts += [f"`--strategy {entry['strategy']}`"] if entry["strategy"] != "plain" else []
    parts += [f"path-traced targets ({entry['spp']} samples)"] if entry["reference"] == "mitsuba" else []
    return ", ".join(parts)


def light_directions_by_filter() -> Lines:
    """Alignment by the number of lights and the size of the filter."""
    found = {
        (entry["lights"], entry["filter_size"]): entry
        for entry in record("lights")["summaries"]
        if (entry["filter"], entry["strategy"], entry["reference"]) == ("gaussian", "plain", "own") and entry["filter_size"]
    }
    sizes = sorted({size for _, size in found})
    rows = [
        [str(n), *(f"{e['alignment_mean']:.4f} ({100 * e['share_from_0.995']:.0f} %)" for e in (found[n, s] for s in sizes))]
        for n in sorted({n for n, _ in found})
    ]
    return markdown(["n", *("unfiltered" if size == 1 else str(size) for size in sizes)], rows)


def light_times() -> Lines:
    """Milliseconds of a step for each run."""
    labels = {
        "batch of 150": "batch of 150",
        "batch of 16": "batch of 16",
        "batch of 1": "batch of 1",
        "reverse": "*reverse*: a frozen single run through ordinary maps with derivatives backwards, G-buffer reused",
        "renderer": "*renderer*: the frozen step of a user who calls `Renderer.render`",
    }
    steps = record("lights-times")["steps"]
    ratios = {"batch of 150": 1.0} | {key.partition(" / ")[0]: value for key, value in steps["ratio_of_medians"].items()}
    rows = [[label, f"{1e3 * steps['seconds'][name]['median']:.2f}", f"{ratios[name]:.2f}"] for name, label in labels.items()]
    return markdown(["way", "ms", "/ batch of 150"], rows)


# Gradients.


def derivative_images() -> Lines:
    """The worst of the motions for each map and filter."""
    found = record("gradients")["jacobian"]
    entries = {key: entry for key, entry in found["entries"].items() if entry["candidate"] == "default"}
    columns, rows = jacobian.jacobian_rows({**found, "entries": entries})
    return markdown(columns[:-1], [row[:-1] for row in rows])


def candidates() -> Lines:
    """The worst of motions x, rotation, size and filters none, 3, 15 for each kind of map."""
    found = record("gradients")["jacobian"]
    kinds, sizes = ("own", "traced_blurred"), (128, 256)
    rows = []
    for name in found["candidates"]:
        row = [name]
        for size in sizes:
            entries = [
                entry
                for entry in found["entries"].values()
                if (entry["candidate"], entry["map"]) == (name, size)
                and entry["motion"] in ("x", "rotation", "scale")
                and entry["filter"] in (1, 3, 15)
            ]
            for kind in kinds:
                farthest = max((entry[kind]["scale"] for entry in entries), key=lambda scale: abs(scale - 1))
                row += [f"{min(entry[kind]['cosine'] for entry in entries):.3f}", f"{farthest:.3f}"]
        rows.append(row)
    return markdown(["", *(title for size in sizes for title in (f"{size}: own c", "s", "blurred c", "s"))], rows)


def projective() -> Lines:
    """Mitsuba's projective integrator."""
    rows = [
        [
            name,
            *(f"{e[key][q]:.3f}" for key in ("agreement_directional", "agreement_area") for q in ("cosine", "scale")),
            f"{e['halves_cosine']:.3f}",
        ]
        for name, e in record("gradients")["jacobian"]["mitsuba"].items()
    ]
    return markdown(["motion", "c, parallel light", "s", "c, the same area light", "s", "c of two halves of its samples"], rows)


def displaced() -> Lines:
    """Displaced occluders."""
    return markdown(*convergence.convergence_rows(record("gradients")["convergence"]))


def displaced_by_map() -> Lines:
    """The plane under the orthographic camera from eight displacements, for all kinds of maps: largest and mean errors."""
    found = record("gradients")
    plain = [
        run
        for run in found["convergence"]["runs"].values()
        if (run["occluder"], run["camera"]) == ("plane", "orthographic") and run["displacement"] <= 0.5
    ]
    kinds: dict[str, list[Mapping[str, Any]]] = {"default": plain}
    for run in found["convergence, kinds of map"]["runs"].values():
        if run["candidate"] != "default":
            kinds.setdefault(run["candidate"], []).append(run)
    finer = list(found["convergence, 512 texels"]["runs"].values())
    kinds["512 texels, in units of 256's"] = finer
    rows = []
    for name, runs in kinds.items():
        unit = 0.5 if runs is finer else 1.0
        row = [name]
        for taps in (1, 3, 5):
            errors = [unit * run["error_texels"] for run in runs if run["filter"] == taps]
            row.append(f"{max(errors):.3f}, {np.mean(errors):.3f}")
        rows.append(row)
    return markdown(["kind of map", *(f"{name}: largest, mean" for name in ("no filter", "3", "5"))], rows)


def minimal_plane() -> Lines:
    """A square with one vertex out of place."""
    found = record("gradients")["minimal-plane"]
    start = math.hypot(*found["settings"]["start"])
    rows = [
        [
            f"{run['camera']}, {'' if run['antialiased'] else 'not '}anti-aliased",
            *(f"{start:.4f}", f"{run['error']:.4f}", "yes" if run["recovered"] else "no"),
        ]
        for run in found["runs"]
    ]
    return markdown(["camera, moments", "error at start", "error", "recovered"], rows)


def agreement() -> Lines:
    """Mitsuba's own tests."""
    return markdown(report.COLUMNS, report.rows(record("agreement")))


# Faces.


def heads(mode: str) -> Lines:
    """Distances from all heads."""
    _, rows = faces.rows(record("faces"), mode)
    columns = ["head", "start, mean", "largest"]
    kept = list(range(9) if mode == "identity" else (0, 1, 2, 3, 4, 6, 7))
    for lights in ("1 shadow", "3 shadows"):
        columns += [f"{lights}, mean", "largest", *(["ms"] if mode == "identity" else [])]
    return markdown(columns, [[row[k] for k in kept] for row in rows])


def expressions(lights: int) -> Lines:
    """Expressions that can be seen."""
    text = faces._expressions(record("faces"), lights)
    return [line for line in text if line.startswith("|")]


# Shadow art.


def art() -> Lines:
    """Intersection over union by kinds of pieces."""
    pieces = record("art")["pieces"]

    def ious(*names: str) -> list[float]:
        return [view["iou"] for name in names for view in pieces[name]["views"]]

    def of_groups(*groups: str) -> list[float]:
        return ious(*(name for name, piece in pieces.items() if piece["group"] in groups))

    def row(label: str, values: Sequence[float], note: str = "") -> list[str]:
        return [label, f"{np.mean(values):.3f}", f"{min(values):.3f}" if len(values) > 1 else "", note]

    remeshed = [f"{name}-remeshed" for name in gallery.WHOLE]
    horse = f"{ious('horse-remeshed')[0]:.3f} with `--remesh 100`"
    return markdown(
        ["", "mean", "least", ""],
        [
            row("one view: airplane, heart, elephant, hand", ious(*gallery.WHOLE), "400 steps"),
            row("the same with `--remesh 100`", ious(*remeshed)),
            row("horse, whose legs are 4 pixels wide", ious("horse"), horse),
            row("two views: six pairs of these four targets, and the letters L and M", of_groups("two views"), "400 steps"),
            row("perspective camera; wavy receiver; both", ious("perspective", "wavy", "wavy-perspective")),
            row("collections: 128 teapots as an elephant, 32 cows as a heart", of_groups("collection"), "1100 steps"),
        ],
    )


def holes() -> Lines:
    """Targets with holes."""
    labels = {
        "cat": "cat",
        "rabbit": "rabbit",
        "duck": "duck (its eye becomes a hole)",
        "kettle": "kettle (its handle and its highlight become holes)",
    }
    pieces = record("art")["pieces"]
    rows = [[label, *(f"{pieces[name]['views'][0][key]:.3f}" for key in ("iou", "iou_filled"))] for name, label in labels.items()]
    return markdown(["", "IoU", "with the target's holes filled"], rows)


# Modelling.


def modelling() -> Lines:
    """Delays and rates of the page."""
    found = record("model")
    delays = {name: 1e3 * np.array(values) for name, values in found["delay_seconds"].items()}
    count = len(delays["first"])
    first, half = delays["first"], delays["half"]
    rows = [
        ["steps a second while painting without a pause", f"{found['steps_per_second']:.0f}"],
        ["frames a second in the browser meanwhile", f"{found['frames_per_second']:.0f}"],
        [
            "from pressing the button until the mesh has moved by a pixel",
            f"{np.median(first):.0f} ms (median of {count} strokes), {max(first):.0f} ms at most",
        ],
        [
            "until it has moved half as far as the stroke goes",
            f"{np.median(half):.0f} ms (median), {max(half):.0f} ms at most",
        ],
    ]
    return markdown(["", ""], rows)


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None or not np.isfinite(value) else f"{value:.{digits}f}"


def _time(seconds: float) -> str:
    return f"{_two_digits(seconds)} s" if seconds >= 1 else f"{_two_digits(1e3 * seconds)} ms"


def _two_digits(value: float) -> str:
    """Two digits, as 0.32, 1.1 and 31."""
    return f"{value:.{max(0, 1 - math.floor(math.log10(value)))}f}"


TABLES: dict[str, Callable[[], Lines]] = {
    "readme": readme,
    "poses": poses,
    "poses of Spot, smooth": lambda: poses_of_spot("vertex"),
    "poses of Spot, flat": lambda: poses_of_spot("face"),
    "poses beside Mitsuba's, flat": lambda: poses_compared("face"),
    "poses beside Mitsuba's, smooth": lambda: poses_compared("vertex"),
    "default shading": default_shading,
    "poses of users' meshes": foreign_meshes,
    "speed": speed,
    "figures": figures,
    "steps on a GPU": on_a_gpu,
    "memory": memory,
    "shadow maps": shadow_maps,
    "poses by shadow maps": poses_by_map,
    "methods": methods,
    "extended lights": extended_lights,
    "extended lights in short": extended_lights_in_short,
    "brightness": brightness,
    "light directions": light_directions,
    "light directions by filter": light_directions_by_filter,
    "times of light directions": light_times,
    "derivative images": derivative_images,
    "kinds of maps": candidates,
    "projective derivatives": projective,
    "displaced occluders": displaced,
    "displaced occluders by maps": displaced_by_map,
    "minimal plane": minimal_plane,
    "agreement": agreement,
    "heads, identity": lambda: heads("identity"),
    "heads, both": lambda: heads("both"),
    "heads, expression": lambda: heads("expression"),
    "expressions, one shadow": lambda: expressions(1),
    "expressions, three shadows": lambda: expressions(3),
    "art": art,
    "holes": holes,
    "modelling": modelling,
}
#: Pages that are written as a whole, below docs/.
FILES: dict[str, Callable[[], str]] = {
    "results/art.md": lambda: "\n".join(gallery.document(record("art"))) + "\n",
    "results/pose-table.md": lambda: pose.document(pose.rows(pose.read([RESULTS / "pose.json"]))),
}


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


if __name__ == "__main__":
    main()

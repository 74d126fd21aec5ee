"""Tables of derivatives."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from shadowmap_dr.experiments.gradients import convergence
from shadowmap_dr.experiments.gradients import report as jacobian
from shadowmap_dr.io.console import markdown

from .records import Lines, record


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

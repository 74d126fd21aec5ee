"""Tables of poses."""

from __future__ import annotations

import numpy as np

from shadowmap_dr.experiments.pose import foreign
from shadowmap_dr.experiments.pose import table as pose
from shadowmap_dr.io.console import markdown

from .records import RESULTS, Lines, record


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
        row = pose_row(case, method)
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


def pose_row(case: str, method: str) -> pose.Row:
    """Spot at 128 x 128."""
    table = pose.rows(pose.read([RESULTS / "pose.json"]))
    (row,) = (row for row in table if (row.case, row.object, row.resolution, row.method) == (case, "spot", 128, method))
    return row


def default_shading() -> Lines:
    """Mitsuba's counts of samples and results with smooth and flat shading, beside ours."""
    rows = []
    for normals, case in (("vertex", "vertex-normals"), ("face", "seen")):
        both = [pose_row(case, method) for method in ("mitsuba", "shadows")]
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


def levenberg_marquardt() -> Lines:
    """Poses found by `--optimiser lm`, and the seconds of its runs."""
    lines, runs = [], record("pose-lm")["runs"]
    for normals in ("vertex", "face"):
        for name in dict.fromkeys(run["object"] for run in runs):
            own = [run for run in runs if (run["object"], run["normals"]) == (name, normals)]
            times = np.array([np.inf if run["seconds_to_pose"] is None else run["seconds_to_pose"] for run in own])
            turned = np.median([run["rotation_error_deg"] for run in own])
            whole = np.median([run["seconds_total"] for run in own])
            found = f"{sum(run['found'] for run in own)} of {len(own)}"
            within = f"{np.count_nonzero(times <= 0.1)}"
            cells = [f"{turned:.4f}", f"{np.median(times):.3f}", f"{times.max():.3f}", within, f"{whole:.3f}"]
            lines.append([{"vertex": "smooth", "face": "flat"}[normals], name, found, *cells])
    times = ["time to pose, median [s]", "longest [s]", "runs within 0.1 s", "whole run, median [s]"]
    return markdown(["shading", "object", "found", "rotation, median [deg]", *times], lines)

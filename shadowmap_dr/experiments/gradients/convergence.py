"""Recovery of an occluder that is displaced sideways, from its shadow alone."""

from __future__ import annotations

import itertools
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from ...inverse import optimize
from ...io import console as io_console
from ...io import files, plot_style, plots, records
from ...io.console import markdown
from ...io.machine import header
from ...io.options import option, setting
from ...io.ranges import FILTER_SIDE, MAP_SIDE, SAMPLES, SIDE, STEPS, check_ranges
from ...rendering.renderer import Renderer
from ..common.meshes import Mesh
from ..common.options import cameras_option
from . import scenes as gradients_scenes
from .fit import ShadowFit
from .images import CANDIDATES, Image, check_chosen, check_maps

#: Error in texels below which an occluder counts as recovered, and the error to aim for.
RECOVERED, HOPED_FOR = 1.0, 0.1
OCCLUDERS = ("plane", "turned plane", "ring")
# Above the perspective camera, which must not see the occluder.
_Z = 1.0
_PLANE, _RING = 0.25, 0.3
# About the light, so that its outlines are not parallel to the texels.
_TURN_DEG = 10.0
MAX_DISPLACEMENT = 0.7
STEP_SIZE, _DECAY = 0.02, 0.005
# The least error of plots, texels.
_LEAST_SHOWN = 1e-4


@dataclass(frozen=True)
class ConvergenceOptions:
    """Options of a run. Everything is run for each candidate, occluder, camera, filter size and displacement.

    The occluders are a square of side 0.5, its outlines parallel to the texels; the same square, turned by 10 degrees about the
    light; a ring 0.59 wide. The step size of Adam falls to 1/200 of the first.
    """

    occluders: tuple[str, ...] = option(
        OCCLUDERS, names=("--occluder",), choices=OCCLUDERS, shown="all", help="Occluder; repeatable."
    )
    cameras: tuple[str, ...] = cameras_option()
    candidates: tuple[str, ...] = option(
        ("default",), names=("--candidate",), choices=CANDIDATES, help="Kind of shadow map; repeatable."
    )
    filter_sizes: tuple[int, ...] = option(
        (1, 3, 15),
        full=(1, 3, 5, 9, 15),
        names=("--filter-size",),
        allowed=FILTER_SIDE,
        help="Texels along each side of the filter, 1 for none; repeatable.",
    )
    displacements: tuple[float, ...] = option(
        (0.1, 0.3, 0.5, 0.65),
        full=(0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.45, 0.5, 0.55, 0.6, 0.65, 0.7),
        names=("--displacement",),
        allowed=(1e-06, MAX_DISPLACEMENT),
        help="Displacement at the start of a run, along x; repeatable.",
    )
    map_resolution: int = option(256, allowed=MAP_SIDE, help="Texels along each side of the map.")
    resolution: int = option(512, allowed=SIDE, help="Image width and height in pixels.")
    iterations: int = option(250, allowed=STEPS, help="Steps of the optimiser.")
    out: Path = option(Path("gradients"), help="Folder for the results.")
    resume: bool = option(False, help="Keep the measurements of a killed run with the same settings.")
    spp: int = setting(512, allowed=SAMPLES, help="Samples per pixel of the path-traced reference.")

    def __post_init__(self) -> None:
        check_ranges(self)
        check_chosen(
            {
                "occluder": (self.occluders, OCCLUDERS),
                "camera": (self.cameras, gradients_scenes.CAMERAS),
                "candidate": (self.candidates, CANDIDATES),
                "filter size": (self.filter_sizes, None),
                "displacement": (self.displacements, None),
            }
        )
        check_maps((self.map_resolution,), self.filter_sizes)


def run_convergence(options: ConvergenceOptions, *, console: Console | None = None) -> dict[str, Any]:
    """Run all; write `convergence.json`, `convergence.md`, a plot and pictures into `options.out`. Returns the record."""
    console = console or io_console.notes()
    path = files.check_output(options.out / "convergence.json", (".json",))
    record = _started(path, options)
    groups = list(itertools.product(options.candidates, options.occluders, options.cameras, options.filter_sizes))
    sheet: dict[str, dict[str, Image]] = {}
    with io_console.progress(console) as progress:
        task = progress.add_task("runs", total=len(groups) * len(options.displacements), note="")
        for label, name, camera, taps in groups:
            progress.update(task, note=f"{name}, {camera}, filter {taps}")
            todo = [d for d in options.displacements if _key(label, name, camera, taps, d) not in record["runs"]]
            pictured = f"{name}, {camera}"
            if not todo and pictured in sheet:
                progress.advance(task, len(options.displacements))
                continue
            fit, texel = _fit(label, name, camera, taps, options)
            if pictured not in sheet:
                start = max(options.displacements)
                sheet[pictured] = {
                    "reference": fit.reference,
                    f"displaced by {start}": fit.method.render((start,)),
                    "own, in place": fit.method.render((0.0,)),
                }
            progress.advance(task, len(options.displacements) - len(todo))
            for displacement in todo:
                history = optimize(fit.method, (displacement,), options.iterations)
                errors = np.abs(history.parameters[:, 0]) / texel
                record["runs"][_key(label, name, camera, taps, displacement)] = {
                    "candidate": label,
                    "occluder": name,
                    "camera": camera,
                    "filter": taps,
                    "displacement": displacement,
                    "texel": texel,
                    "error_texels": float(errors[-1]),
                    "recovered": bool(errors[-1] < RECOVERED),
                    "seconds_per_iteration": history.seconds_per_iteration,
                    "error_curve_texels": errors,
                    "loss_curve": history.loss,
                }
                records.write_record(path, record, "runs")
                progress.advance(task)
    record = records.plain(record)
    records.write_record(path, record, "runs")
    plots.image_sheet(options.out / "convergence-images.png", sheet)
    note = "Curves of one colour are runs with different displacements at the start."
    plots.plot_curves(options.out / "convergence.png", _curves(record), columns=2, caption=note)
    plot_errors(options.out / "convergence-errors.png", record)
    with files.atomic(options.out / "convergence.md") as temporary:
        temporary.write_text(read_convergence(record), encoding="utf-8")
    return record


# Without `candidate`: records of earlier versions.
_NEEDED = (
    *("occluder", "camera", "filter", "displacement", "texel", "error_texels", "recovered", "seconds_per_iteration"),
    *("error_curve_texels", "loss_curve"),
)


def _started(path: Path, options: ConvergenceOptions) -> dict[str, Any]:
    identity = {
        "map_resolution": options.map_resolution,
        "resolution": options.resolution,
        "iterations": options.iterations,
        "spp": options.spp,
        "step_size": STEP_SIZE,
        "decay": _DECAY,
    }
    record: dict[str, Any] = {**header(identity), "runs": {}}
    if options.resume and path.exists():
        record = _with_candidates(records.read_record(path, record, {"runs": _NEEDED}, _report))
    return record


def _with_candidates(record: dict[str, Any]) -> dict[str, Any]:
    """A record with a candidate for each run: records of earlier versions have the default only."""
    return {**record, "runs": {key: {"candidate": "default", **run} for key, run in record["runs"].items()}}


def _report(record: dict[str, Any]) -> None:
    """Make what is written of the runs, for its errors."""
    complete = _with_candidates(record)
    read_convergence(complete)
    for panel in _curves(complete).values():
        for curves in panel.values():
            np.array(curves, np.float64)


def _key(label: str, name: str, camera: str, taps: int, displacement: float) -> str:
    return " | ".join([*_unless_default(label), name, camera, str(taps), f"{displacement:g}"])


def _unless_default(label: str) -> list[str]:
    return [label] if label != "default" else []


@dataclass(frozen=True)
class _Fit:
    method: ShadowFit
    reference: Image


def _fit(label: str, name: str, camera: str, taps: int, options: ConvergenceOptions) -> tuple[_Fit, float]:
    """Method for an occluder that moves along x, its path-traced target, and the width of a texel in world units."""
    from mitsuba_baselines.reference import path_traced

    mesh = occluder(name)
    scene = gradients_scenes.build(mesh, options.resolution, camera)
    reference = path_traced(scene, spp=options.spp).image
    filters: dict[str, Any] = {"shadow_filter": "gaussian" if taps > 1 else "none", "shadow_filter_size": taps}
    renderer = Renderer.from_scene(scene, shadow_map_resolution=options.map_resolution, **filters, **CANDIDATES[label])
    basis = np.zeros((1, *mesh.vertices.shape))
    basis[0, :, 0] = 1
    method = ShadowFit(renderer, mesh.vertices, basis, reference, step_size=STEP_SIZE, decay=(_DECAY, options.iterations))
    frusta = renderer.frusta
    assert frusta is not None  # the renderer has a shadow map
    return _Fit(method, reference), 2 * float(max(frusta.half_x[0], frusta.half_y[0])) / options.map_resolution


def occluder(name: str) -> Mesh:
    """The mesh of one of `OCCLUDERS`, in its target position."""
    if name == "ring":
        return gradients_scenes.ring(8000, _Z, _RING)
    return gradients_scenes.plane(_PLANE, _Z, 0.0 if name == "plane" else _TURN_DEG)


def _curves(record: Mapping[str, Any]) -> dict[str, dict[str, list[list[float]]]]:
    """Curves of the error over iterations: a panel for each occluder and camera, a colour for each filter."""
    panels: dict[str, dict[str, list[list[float]]]] = {}
    for run in record["runs"].values():
        panel = panels.setdefault(f"{run['occluder']}, {run['camera']}:\nerror [texels]", {})
        panel.setdefault(_label(run), []).append(run["error_curve_texels"])
    return panels


def plot_errors(path: str | os.PathLike[str], record: Mapping[str, Any]) -> None:
    """Plot the error at the end over the displacement: a panel for each occluder and camera, a line for each filter."""
    panels: dict[tuple[str, str], dict[str, dict[float, float]]] = {}
    for run in record["runs"].values():
        own = panels.setdefault((run["occluder"], run["camera"]), {}).setdefault(_label(run), {})
        own[run["displacement"]] = run["error_texels"]
    columns = min(2, len(panels))
    rows = -(-len(panels) // columns)
    with plot_style.drawn(path, 5.2 * columns, 0.4 + 2.9 * rows, dpi=110) as figure:
        grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        labels: list[tuple[Any, list[tuple[float, str, str]]]] = []  # Any: Axes
        for k, ((occluder, camera), series) in enumerate(panels.items()):
            axes: Any = grid.flat[k]  # Any: Axes
            ends: list[tuple[float, str, str]] = []
            for number, (label, errors) in enumerate(series.items()):
                tint = plot_style.colour(number)
                # A displacement that left nothing to find has an error of zero, which no logarithm has.
                points = [(x, max(y, _LEAST_SHOWN)) for x, y in sorted(errors.items())]
                axes.plot(
                    *zip(*points, strict=True), color=tint, marker=plot_style.marker(number), linestyle=plot_style.dash(number)
                )
                ends.append((points[-1][1], label, tint))
            axes.axhline(RECOVERED, color=plot_style.GREY, linestyle=":", linewidth=1)
            axes.set_yscale("log")
            axes.set(title=f"{occluder}, {camera} camera")
            if k % columns == 0:
                axes.set_ylabel("error at the end [texels]")
            if k >= len(panels) - columns:
                axes.set_xlabel("displacement at the start [units]")
            labels.append((axes, ends))
        for labelled in labels:  # only now, since the limits are those of all panels
            plot_style.label_ends(*labelled)
        for empty in list(grid.flat)[len(panels) :]:
            empty.set_axis_off()
        plot_style.caption(
            figure,
            f"Points: runs. Dotted: a texel, below which an occluder is recovered. Errors below {_LEAST_SHOWN} are drawn there.",
        )


def _label(run: Mapping[str, Any]) -> str:
    return ", ".join([f"filter {run['filter']}" if run["filter"] > 1 else "no filter", *_unless_default(run["candidate"])])


def convergence_rows(record: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Columns, and a row for each occluder, camera, filter and kind of map: displacements of recovery, and largest error."""
    groups: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for run in record["runs"].values():
        groups.setdefault((run["occluder"], run["camera"], run["filter"], run["candidate"]), []).append(run)
    rows = []
    for (name, camera, taps, label), runs in groups.items():
        runs = sorted(runs, key=lambda run: run["displacement"])
        far = largest_recovered(runs)
        found = [run["error_texels"] for run in runs if run["recovered"]]
        kind = ", ".join([name, camera, str(taps) if taps > 1 else "none", *_unless_default(label)])
        rows.append([kind, f"{len(found)}/{len(runs)}", f"{far:g}" if far else "-", f"{max(found):.3f}" if found else "-"])
    return ["occluder, camera, filter", "recovered", "from up to", "largest error"], rows


def largest_recovered(runs: list[Mapping[str, Any]]) -> float:
    """Largest displacement such that the occluder was recovered from it and from all smaller ones; 0 if there is none."""
    largest = 0.0
    for run in sorted(runs, key=lambda run: run["displacement"]):
        if not run["recovered"]:
            break
        largest = run["displacement"]
    return largest


def convergence_table(record: Mapping[str, Any]) -> Table:
    """The table for the terminal."""
    return io_console.table("Displaced occluders (error of the recovered ones in texels)", *convergence_rows(record))


def read_convergence(record: Mapping[str, Any]) -> str:
    """Report in Markdown: the table and its summary."""
    s, runs = record["settings"], list(record["runs"].values())
    found = [run for run in runs if run["recovered"]]
    near = [run for run in found if run["error_texels"] <= HOPED_FOR]
    lines = [
        "# An occluder recovered from its shadow",
        "",
        f"Displaced along x, path-traced reference ({s['spp']} samples, {s['resolution']} x {s['resolution']} pixels), "
        f"map of {s['map_resolution']} texels, {s['iterations']} steps of Adam. Recovered: within a texel.",
        "",
    ]
    lines += markdown(*convergence_rows(record)) + [""]
    lines.append(f"{len(found)} of {len(runs)} runs recover the occluder, {len(near)} of these to {HOPED_FOR} texel.")
    worst = max(found, key=lambda run: run["error_texels"], default=None)
    if worst is not None and worst["error_texels"] > HOPED_FOR:
        lines.append(
            f"The worst of them: {worst['occluder']}, {worst['camera']}, filter {worst['filter']}, "
            f"{worst['error_texels']:.3f} texels."
        )
    for name in dict.fromkeys(run["occluder"] for run in runs):
        width = float(np.ptp(occluder(name).vertices[:, 0]))
        lost = [run["displacement"] for run in runs if run["occluder"] == name and not run["recovered"]]
        kept = [run["displacement"] for run in runs if run["occluder"] == name and run["recovered"]]
        lines.append(
            f"The {name} is {width:.2f} wide; it was recovered from up to {max(kept, default=0):g}, "
            + (f"and lost, in some case, from {min(lost):g}." if lost else "and never lost.")
        )
    return "\n".join(lines) + "\n"

"""The smallest case: recovery of one displaced vertex of a square occluder, with and without anti-aliased shadow maps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from ...inverse import optimize
from ...io import console as io_console
from ...io import files, plots, records
from ...io.console import markdown
from ...io.machine import header
from ...io.options import option, setting
from ...io.ranges import FILTER_SIDE, MAP_SIDE, SAMPLES, SIDE, STEPS, check_ranges
from ...rendering.renderer import Renderer
from ..common.options import cameras_option
from . import scenes as gradients_scenes
from .fit import ShadowFit
from .images import Image, check_chosen, check_maps

#: Largest error of a recovered vertex, world units.
RECOVERED = 0.002
Z, HALF, VERTEX = 1.0, 0.75, 2
STEP_SIZE = 0.005
CASES = {"anti-aliased": True, "not anti-aliased": False}


@dataclass(frozen=True)
class PlaneOptions:
    """Options of a run. Each camera is run with and without anti-aliased moments."""

    cameras: tuple[str, ...] = cameras_option()
    map_resolution: int = option(256, allowed=MAP_SIDE, help="Texels along each side of the map.")
    filter_size: int = option(3, allowed=FILTER_SIDE, help="Texels along each side of the filter.")
    resolution: int = option(512, allowed=SIDE, help="Image width and height in pixels.")
    iterations: int = option(150, allowed=STEPS, help="Steps of the optimiser.")
    out: Path = option(Path("gradients"), help="Folder for the results.")
    spp: int = setting(512, allowed=SAMPLES, help="Samples per pixel of the path-traced reference.")

    def __post_init__(self) -> None:
        check_ranges(self)
        check_chosen({"camera": (self.cameras, gradients_scenes.CAMERAS)})
        check_maps((self.map_resolution,), (self.filter_size,))


def run_plane(options: PlaneOptions, *, console: Console | None = None) -> dict[str, Any]:
    """Run all; write `minimal-plane.json`, `minimal-plane.md`, a plot and pictures into `options.out`. Returns the record."""
    from mitsuba_baselines.reference import path_traced

    console = console or io_console.notes()
    path = files.check_output(options.out / "minimal-plane.json", (".json",))
    mesh = gradients_scenes.plane(HALF, Z)
    basis = np.zeros((2, *mesh.vertices.shape))
    basis[0, VERTEX, 0] = basis[1, VERTEX, 1] = 1
    start = -0.5 * mesh.vertices[VERTEX, :2].astype(np.float64)
    settings = {
        "map_resolution": options.map_resolution,
        "filter_size": options.filter_size,
        "resolution": options.resolution,
        "iterations": options.iterations,
        "spp": options.spp,
        "step_size": STEP_SIZE,
        "start": start,
    }
    record: dict[str, Any] = {**header(settings), "runs": []}
    sheet: dict[str, dict[str, Image]] = {}
    with io_console.progress(console) as progress:
        task = progress.add_task("steps", total=len(options.cameras) * len(CASES) * options.iterations, note="")
        for camera in options.cameras:
            scene = gradients_scenes.build(mesh, options.resolution, camera)
            reference = path_traced(scene, spp=options.spp).image
            for label, antialiased in CASES.items():
                progress.update(task, note=f"{camera}, {label}")
                renderer = Renderer.from_scene(
                    scene,
                    shadow_map_resolution=options.map_resolution,
                    shadow_filter_size=options.filter_size,
                    shadow_antialias=antialiased,
                )
                fit = ShadowFit(renderer, mesh.vertices, basis, reference, step_size=STEP_SIZE)
                history = optimize(fit, start, options.iterations, on_step=lambda _: progress.advance(task))
                errors = np.linalg.norm(history.parameters, axis=1)
                record["runs"].append(
                    {
                        "camera": camera,
                        "antialiased": antialiased,
                        "error": errors[-1],
                        "recovered": bool(errors[-1] <= RECOVERED),
                        "final": history.final,
                        "seconds_per_iteration": history.seconds_per_iteration,
                        "error_curve": errors,
                        "loss_curve": history.loss,
                    }
                )
                result = fit.render(history.final)
                sheet[f"{camera}, {label}"] = {
                    "reference": reference,
                    "start": fit.render(start),
                    "result": result,
                    "difference": np.abs(result - reference),
                }
    record = records.plain(record)
    records.write_json(path, record)
    plots.image_sheet(options.out / "minimal-plane-images.png", sheet)
    labels = {"error": "distance of the vertex from its place [units]", "loss": "loss (mean squared difference)"}
    runs = {f"{run['camera']},\n{_label(run)}": run for run in record["runs"]}
    curves = {label: {name: [run[f"{key}_curve"]] for name, run in runs.items()} for key, label in labels.items()}
    plots.plot_curves(options.out / "minimal-plane.png", curves)
    with files.atomic(options.out / "minimal-plane.md") as temporary:
        temporary.write_text(read_plane(record), encoding="utf-8")
    return record


def _label(run: Mapping[str, Any]) -> str:
    return next(label for label, antialiased in CASES.items() if antialiased == run["antialiased"])


def plane_rows(record: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Columns, and a row for each run."""
    rows = [
        [
            f"{run['camera']}, {_label(run)}",
            f"{run['error_curve'][0]:.4f}",
            f"{run['error']:.4f}",
            "yes" if run["recovered"] else "no",
        ]
        for run in record["runs"]
    ]
    return ["camera, moments", "error at start", "error", "recovered"], rows


def plane_table(record: Mapping[str, Any]) -> Table:
    """The table for the terminal."""
    return io_console.table("A vertex recovered from the shadow: distance from its place [units]", *plane_rows(record))


def read_plane(record: Mapping[str, Any]) -> str:
    """Report in Markdown: the table and its summary."""
    s = record["settings"]
    lines = [
        "# A square with one vertex out of place",
        "",
        f"Path-traced reference ({s['spp']} samples, {s['resolution']} x {s['resolution']} pixels), map of "
        f"{s['map_resolution']} texels, {s['iterations']} steps of Adam of {s['step_size']}.",
        "",
    ]
    lines += markdown(*plane_rows(record)) + [""]
    for antialiased in (True, False):
        runs = [run for run in record["runs"] if run["antialiased"] == antialiased]
        if runs:
            found, moved = sum(run["recovered"] for run in runs), max(abs(run["error_curve"][0] - run["error"]) for run in runs)
            errors = ", ".join(format(run["error"], ".4f") for run in runs)
            lines.append(
                f"With{'' if antialiased else 'out'} anti-aliased moments {found} of {len(runs)} are recovered to "
                f"{RECOVERED} (errors {errors}" + (")." if moved > 0 else "; the vertex never moves: there is no gradient).")
            )
    return "\n".join(lines) + "\n"

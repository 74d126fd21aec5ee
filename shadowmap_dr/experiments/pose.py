"""Pose estimation: three methods find an object's pose from an image of it and its shadow on a wall.

Protocol: the object in front of a wall is turned about the vertical axis and shifted in the plane of the wall; the target
pose is zero. Methods: `shadows` (this library), `rasterizer` (the same without shadows) and `mitsuba` (Mitsuba's
projective integrator, with an area light in place of the directional one and the cheapest setting that converges).
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import Progress, TaskID
from rich.table import Table

from .. import __version__, assets, io, report
from ..errors import ShadowmapError
from ..inverse import History, Method, PoseFit, optimize
from .pose_scene import (
    NormalKind,
    PoseProblem,
    ReferenceKind,
    make_problem,
    path_traced_reference,
    pose_errors,
    start_pose,
)

METHODS = ("shadows", "rasterizer", "mitsuba")
RECOVERED_DEG, RECOVERED_X100 = 0.2, 0.3
TIME_TO_POSE_DEG = 0.1
STEP_SIZE = 0.01
BETAS = (0.9, 0.999)

Image = npt.NDArray[np.float32]


@dataclass(frozen=True)
class PoseOptions:
    """What to run. Everything is run for each object, resolution, run and method."""

    objects: tuple[str, ...] = ("spot",)
    resolutions: tuple[int, ...] = (128,)
    methods: tuple[str, ...] = METHODS
    runs: int = 1
    seed: int = 0
    iterations: int = 150
    reference: ReferenceKind = "mitsuba"
    shadow_only: bool = False
    normals: NormalKind = "face"
    samples: int = 1
    out: Path = Path("pose")
    resume: bool = False

    def __post_init__(self) -> None:
        for name, values in (("object", self.objects), ("resolution", self.resolutions), ("method", self.methods)):
            if not values:
                raise ShadowmapError(f"no {name} given: name at least one.")
            if len(set(values)) != len(values):
                raise ShadowmapError(f"a {name} is given twice in {', '.join(map(str, values))}: name each once.")
        for method in self.methods:
            if method not in METHODS:
                raise ShadowmapError(f"no method {method!r}: choose from {', '.join(METHODS)}.")
        for name, value in (("runs", self.runs), ("iterations", self.iterations), ("samples per pixel", self.samples)):
            if value < 1:
                raise ShadowmapError(f"{value} {name}: give at least 1.")
        if self.seed < 0:
            raise ShadowmapError(f"the seed {self.seed}: give 0 or more.")
        if self.reference not in ("mitsuba", "own"):
            raise ShadowmapError(f"no reference {self.reference!r}: choose mitsuba or own.")
        if self.normals not in ("face", "vertex"):
            raise ShadowmapError(f"no normals {self.normals!r}: choose face or vertex.")


Builder = Callable[[str, PoseProblem, Image], Method]


def build_method(name: str, problem: PoseProblem, reference: Image, samples: int = 1) -> Method:
    """One of the three methods for a problem and its reference image; our own ones with so many samples per pixel."""
    if name == "mitsuba":
        from mitsuba_baselines import pose as baseline

        setting = baseline.fair_setting(problem.resolution, problem.normals)
        return baseline.MitsubaPose(
            assets.scene("pose"),
            problem.mesh,
            problem.resolution,
            setting,
            reference,
            step_size=STEP_SIZE,
            betas=BETAS,
            shift_z=problem.shift_z,
            normals=problem.normals,
        )
    from ..renderer import Renderer

    settings = shadow_settings(name)
    renderer = Renderer.from_scene(problem.scene, **settings)
    if samples != 1:
        settings["samples_per_pixel"] = samples
    return PoseFit(
        renderer,
        "object",
        problem.p_rest,
        reference,
        step_size=STEP_SIZE,
        betas=BETAS,
        shift_z=problem.shift_z,
        spp=samples,
        settings=settings,
    )


def shadow_settings(method: str) -> dict[str, Any]:
    """Options of the `Renderer` that the methods `shadows` and `rasterizer` use."""
    if method == "rasterizer":
        return {"shadow_method": "none"}
    return {"shadow_method": "vsm", "shadow_map_resolution": 256, "shadow_filter": "gaussian", "shadow_filter_size": 3}


def run_pose(options: PoseOptions, *, build: Builder = build_method, console: Console | None = None) -> list[dict[str, Any]]:
    """Run the experiment and write its results below `options.out`.

    Files: `pose.json` (a list with one record for each object, resolution, method and run), and for each object and
    resolution a folder with the reference, the images at start and end and their difference from the reference, a plot
    of the convergence (`convergence.png`) and a sheet with the images of the first run (`images.png`).

    Records that are complete are kept if `options.resume` is set, and a run that was killed goes on from its last
    checkpoint, at most ten iterations before the end. Returns the records of this call's runs, in the order of the file.
    """
    console = console or Console(stderr=True)
    if build is build_method:
        build = functools.partial(build_method, samples=options.samples)
    out = options.out
    io.check_output(out / "pose.json", (".json",))
    stored: list[dict[str, Any]] = []
    if options.resume and (out / "pose.json").exists():
        stored = report.read_json(out / "pose.json")
        if not isinstance(stored, list) or not all(isinstance(record, dict) for record in stored):
            raise ShadowmapError(f"{out / 'pose.json'} is no list of records: choose another folder.")

    problems = [
        make_problem(name, resolution, shadow_only=options.shadow_only, normals=options.normals, work=out / "objects")
        for name in options.objects
        for resolution in options.resolutions
    ]
    if len({problem.folder for problem in problems}) != len(problems):
        raise ShadowmapError(f"two of the objects {', '.join(options.objects)} have the same name: rename one file.")

    result: list[dict[str, Any]] = []
    with report.progress(console) as progress:
        for problem in problems:
            task = progress.add_task(f"{problem.folder} reference and methods", total=None, note="")
            reference = _reference(problem, options, build)
            # Built once and used for all runs: what a method compiled stays warm, and what cannot be built fails at once.
            methods = {name: build(name, problem, reference) for name in options.methods}
            progress.remove_task(task)
            for method in methods.values():
                if _fairness(method, problem).get("fair") is False:
                    note = "sample counts found at another resolution, where they converge; here nobody has searched"
                    progress.console.print(f"{problem.folder} mitsuba: {note}: {getattr(method, 'setting', '')}", highlight=False)
            records, images = [], {}
            for run in range(options.runs):
                for name in options.methods:
                    title = f"{problem.folder} {name} run {run}"
                    task = progress.add_task(title, total=options.iterations, note="")
                    step = functools.partial(_show, progress, task)
                    record = _run_one(problem, name, run, options, methods[name], stored, step)
                    final = record["final"] if None not in record["final"] else start_pose(options.seed, run)
                    pictures = _pictures(methods[name], record["start"], final, reference)
                    for picture, image in pictures.items():
                        io.write_png(out / problem.folder / f"{name}-run{run}-{picture}.png", image)
                    if run == 0:
                        images[name] = pictures
                    records.append(record)
                    stored = [*(other for other in stored if _key(other) != _key(record)), record]
                    report.write_json(out / "pose.json", stored)
                    _checkpoint(problem, name, run, options).unlink(missing_ok=True)
                    progress.remove_task(task)
                    progress.console.print(f"{title}: {_outcome(record)}", highlight=False)
            _plots(problem, options, records, images, reference)
            result += records
    return result


def table(records: Sequence[dict[str, Any]]) -> Table:
    """Mean errors and times over the runs, a row for each object, resolution and method (the paper's Table 1)."""
    rows = []
    for group in _groups(records):
        first = group[0]
        recovered = sum(record["recovered"] for record in group)
        smooth = _normals(first) == "vertex"
        rows.append(
            [
                first["object"] + (" (shadow)" if first["shadow_only"] else "") + (" (smooth)" if smooth else ""),
                str(first["resolution"]),
                first["method"],
                f"{recovered}/{len(group)}",
                _mean(group, "rotation_error_deg", "{:.3f}"),
                _mean(group, "translation_error_x100", "{:.3f}"),
                _mean(group, "seconds_per_iteration", "{:.4f}"),
                _mean(group, "seconds_total", "{:.1f}"),
            ]
        )
    columns = ["object", "pixels", "method", "found", "degrees", "offset", "s/step", "s total"]
    return report.table("Poses found, mean rotation error in degrees, mean offset error x 100, times", columns, rows)


def _run_one(
    problem: PoseProblem,
    name: str,
    run: int,
    options: PoseOptions,
    method: Method,
    stored: Sequence[dict[str, Any]],
    on_step: Callable[[int], None],
) -> dict[str, Any]:
    """The record of a run: a stored one if there is one for exactly these settings, else that of a run made now."""
    start = start_pose(options.seed, run)
    identity = report.plain(
        {
            "object": problem.name,
            "resolution": problem.resolution,
            "method": name,
            "run": run,
            "seed": options.seed,
            "start": start,
            "iterations": options.iterations,
            "reference": options.reference,
            "shadow_only": problem.shadow_only,
            "normals": problem.normals,
            "settings": {"object_digest": problem.digest, **method.describe(), **_fairness(method, problem)},
        }
    )
    for record in stored:
        if all(record.get(key) == value for key, value in identity.items()):
            return record
    path = _checkpoint(problem, name, run, options)
    if not options.resume:
        path.unlink(missing_ok=True)
    history = optimize(method, start, options.iterations, checkpoint=path, settings=identity, on_step=on_step)
    return {**identity, **_results(history), "environment": _environment()}


def _fairness(method: Method, problem: PoseProblem) -> dict[str, bool]:
    """For Mitsuba's method: whether a search found its sample counts to be the cheapest ones that converge."""
    setting = getattr(method, "setting", None)
    if setting is None:
        return {}
    from mitsuba_baselines.pose import is_fair

    return {"fair": is_fair(setting, problem.resolution, problem.normals)}


def _show(progress: Progress, task: TaskID, done: int) -> None:
    progress.update(task, completed=done, note="")


def _results(history: History) -> dict[str, Any]:
    rotation, translation = pose_errors(history.parameters)
    return report.plain(
        {
            "final": history.final,
            "rotation_error_deg": rotation[-1],
            "translation_error_x100": translation[-1],
            "recovered": bool(rotation[-1] < RECOVERED_DEG and translation[-1] < RECOVERED_X100),
            "seconds_per_iteration": history.seconds_per_iteration,
            "seconds_total": history.seconds_total,
            "seconds_to_pose": seconds_to_pose(rotation, history.seconds),
            "loss_curve": history.loss,
            "rotation_error_curve": rotation,
            "translation_error_curve": translation,
        }
    )


def seconds_to_pose(rotation_deg: npt.NDArray[np.float64], seconds: npt.NDArray[np.float64]) -> float | None:
    """Seconds until the rotation error is at most 0.1 degrees and stays there, None if it never does."""
    outside = np.flatnonzero(~(rotation_deg <= TIME_TO_POSE_DEG))
    first = int(outside[-1]) + 1 if len(outside) else 0
    return float(seconds[:first].sum()) if first < len(rotation_deg) else None


def _reference(problem: PoseProblem, options: PoseOptions, build: Builder) -> Image:
    folder = options.out / problem.folder
    if options.reference == "mitsuba":
        image = path_traced_reference(problem, folder / "reference.exr")
    else:
        blank = np.zeros((problem.resolution, problem.resolution, 3), np.float32)
        image = build("shadows", problem, blank).render(np.zeros(3))
        io.write_image(folder / "reference-own.exr", image)
    io.write_png(folder / "reference.png", image)
    return image


def _pictures(method: Method, start: npt.ArrayLike, final: npt.ArrayLike, reference: Image) -> dict[str, Image]:
    result = method.render(final)
    return {"start": method.render(start), "result": result, "difference": np.abs(result - reference)}


def _plots(
    problem: PoseProblem,
    options: PoseOptions,
    records: Sequence[dict[str, Any]],
    images: dict[str, dict[str, Image]],
    reference: Image,
) -> None:
    panels = {
        "rotation error [degrees]": "rotation_error_curve",
        "offset error x 100": "translation_error_curve",
        "loss": "loss_curve",
    }
    curves = {
        label: {name: [record[key] for record in records if record["method"] == name] for name in options.methods}
        for label, key in panels.items()
    }
    report.plot_curves(options.out / problem.folder / "convergence.png", curves)
    rows = {name: {"reference": reference, **pictures} for name, pictures in images.items()}
    report.image_sheet(options.out / problem.folder / "images.png", rows)


def _checkpoint(problem: PoseProblem, name: str, run: int, options: PoseOptions) -> Path:
    return options.out / problem.folder / f"{name}-run{run}-seed{options.seed}.checkpoint.npz"


def _key(record: dict[str, Any]) -> tuple[Any, ...]:
    """What a record is about: a newer one with the same key takes its place."""
    names = ("object", "resolution", "method", "run", "seed", "reference", "shadow_only")
    return (*(record.get(name) for name in names), _normals(record))


def _normals(record: dict[str, Any]) -> str:
    """Records from before there was a choice are of flat shading."""
    return record.get("normals", "face")


def _groups(records: Sequence[dict[str, Any]]) -> Iterator[list[dict[str, Any]]]:
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for record in records:
        key = (record["object"], record["resolution"], record["shadow_only"], _normals(record), record["method"])
        groups.setdefault(key, []).append(record)
    yield from groups.values()


def _mean(group: Sequence[dict[str, Any]], key: str, form: str) -> str:
    values = [record[key] for record in group]
    return "failed" if any(value is None for value in values) else form.format(sum(values) / len(values))


def _outcome(record: dict[str, Any]) -> str:
    values = (_mean([record], key, "{:.3f}") for key in ("rotation_error_deg", "translation_error_x100"))
    time = _mean([record], "seconds_per_iteration", "{:.4f}")
    return "rotation {} deg, offset x 100 {}, {} s per iteration".format(*values, time)


def _environment() -> dict[str, Any]:
    return {
        "shadowmap_dr": __version__,
        "mitsuba": mi.__version__,
        "drjit": dr.__version__,
        "variant": mi.variant(),
        "threads": dr.thread_count(),
        "load_average": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
    }

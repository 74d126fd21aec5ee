"""Pose estimation: three methods recover an object's pose from an image of the object and its shadow on a wall.

Protocol: the object in front of a wall is turned about the vertical axis and shifted in the plane of the wall; the target
pose is zero. Methods: `shadows` (this library), `rasterizer` (the same without shadows) and `mitsuba` (Mitsuba's
projective integrator, with an area light in place of the directional one and the cheapest setting that converges).
"""

from __future__ import annotations

import dataclasses
import functools
import glob
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table

from ...errors import ShadowmapError, did_you_mean
from ...inverse import Method, run_sweep
from ...inverse.runs.schedulers import check_scheduler, check_threads
from ...io import assets, files, plots
from ...io import console as io_console
from ...io import images as io_images
from ...io import records as io_records
from ...io.machine import header
from ...io.options import option
from ...io.ranges import RUNS, SEED, STEPS, check_ranges
from ..common.options import scheduler_option, threads_option
from .advice import reasons
from .methods import METHODS, Builder, Image, build_method, described, fairness, searching, setting_text, usual_normals
from .picture import Course, draw
from .record import identity, is_of, make_record, stored_records
from .run_steps import RunSteps
from .scene import NormalKind, PoseProblem, ReferenceKind, folder_name, make_problem, pose_errors, start_pose
from .search import Search, choose, number_or_auto
from .sweep import PoseRuns, make_reference

# File of the picture of a problem, in its folder.
_PICTURE = "pose.png"
# Choices of `search.choose`, for the help.
_AUTO = (
    "auto: 1 for objects of this package; 1, 4 or 16 for files, by the width of facets",
    "auto: 0 for objects of this package; a sixteenth of the image for files",
    "auto: 1 for objects of this package; 5 for files",
)


def _number(name: str) -> Callable[[str], float | None]:
    def parse(text: str) -> float | None:
        return number_or_auto(f"{name} (--{name})", text)

    return parse


@dataclass(frozen=True)
class PoseOptions:
    """Options of a run. Everything is run for each object, resolution, run and method."""

    objects: tuple[str, ...] = option(
        ("spot",), names=("--object",), metavar="NAME|FILE", help="Mesh of this package, .ply or .obj; repeatable."
    )
    resolutions: tuple[int, ...] = option(
        (128,), names=("--resolution",), allowed=(8, 4096), help="Image width and height in pixels; repeatable."
    )
    methods: tuple[str, ...] = option(
        METHODS,
        names=("--method",),
        choices=METHODS,
        shown="all; the first two with --shadow-only",
        help="Method; repeatable.",
    )
    runs: int = option(1, allowed=RUNS, help="Number of runs, each with its own start.")
    seed: int = option(0, allowed=SEED, help="Seed of the starts: run r uses seed + r.")
    iterations: int = option(150, allowed=STEPS, help="Steps of the optimiser.")
    reference: ReferenceKind = option("mitsuba", help="Reference image: path-traced, or rendered by this library.")
    shadow_only: bool = option(False, help="The camera sees the shadow but not the object.")
    normals: NormalKind | None = option(
        None,
        metavar="face|vertex",
        shown="vertex for objects of this package, face for files",
        help="Shading of the object: flat, or smooth.",
    )
    samples: int | None = option(
        None,
        metavar="N|auto",
        shown=_AUTO[0],
        parse=_number("samples"),
        allowed=(1, 4096),
        help="Samples per pixel of our methods.",
    )
    blur: float | None = option(
        None, metavar="PIXELS|auto", shown=_AUTO[1], parse=_number("blur"), allowed=(0.0, 512.0),
        help="Blur of the first step's differences, which shrinks to zero.",
    )  # fmt: skip
    tries: int | None = option(
        None, metavar="N|auto", shown=_AUTO[2], parse=_number("tries"), allowed=(1, 13),
        help="Most descents of a run, from other rotations while the image is not explained.",
    )  # fmt: skip
    optimiser: Literal["adam", "lm"] = option(
        "adam", help="Optimiser of our methods: Adam, or Levenberg and Marquardt's method from coarse images to fine ones."
    )
    out: Path = option(Path("pose"), help="Folder for the results.")
    resume: bool = option(False, help="Keep finished runs, resume killed ones.")
    scheduler: str = scheduler_option()
    threads: int = threads_option()

    def __post_init__(self) -> None:
        check_ranges(self)
        for name, values in (("object", self.objects), ("resolution", self.resolutions), ("method", self.methods)):
            if not values:
                raise ShadowmapError(f"no {name} given: name at least one.")
            if len(set(values)) != len(values):
                raise ShadowmapError(f"one {name} is given twice in {', '.join(map(str, values))}: name each once.")
        for method in self.methods:
            if method not in METHODS:
                raise ShadowmapError(f"no method {method!r}: choose from {', '.join(METHODS)}.{did_you_mean(method, METHODS)}")
        check_threads(self.threads)
        if self.reference not in ("mitsuba", "own"):
            raise ShadowmapError(f"no reference {self.reference!r}: choose mitsuba or own.")
        if self.optimiser not in ("adam", "lm"):
            raise ShadowmapError(f"no optimiser {self.optimiser!r}: choose adam or lm.")
        if self.normals not in (None, "face", "vertex"):
            raise ShadowmapError(f"no normals {self.normals!r}: choose face or vertex.")
        check_scheduler(self.scheduler)

    def normals_of(self, name: str) -> NormalKind:
        """Shading of an object."""
        return usual_normals(name) if self.normals is None else self.normals

    @property
    def settings(self) -> dict[str, Any]:
        """Settings that the results depend on."""
        left_out = ("out", "resume", "scheduler", "threads")
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in left_out}


def run_pose(options: PoseOptions, *, build: Builder = build_method, console: Console | None = None) -> list[dict[str, Any]]:
    """Run the experiment and write its results below `options.out`.

    Files: `pose.json` (`runs` has one record for each object, resolution, method and run), and for each object and
    resolution a folder with a picture of all methods, their results and errors over time (`pose.png`), the reference, the images
    at start and end and their difference from the reference, a plot of the convergence (`convergence.png`) and a sheet with the
    images of the first run (`images.png`). Reference, start and the picture so far are written before Mitsuba's method begins.

    Complete records are kept if `options.resume` is set, and a killed run continues from its last checkpoint, at most ten
    iterations back. Returns the records of this call's runs, in the order of the file.

    With a scheduler (see :func:`shadowmap_dr.inverse.run_sweep`) its workers make the runs, with methods of :func:`build_method`.
    Runs that share a machine take longer than runs alone.
    """
    console = console or io_console.notes()
    out = options.out
    files.check_output(out / "pose.json", (".json",))
    stored: list[dict[str, Any]] = []
    if options.resume and (out / "pose.json").exists():
        stored = stored_records(out / "pose.json")

    problems = {
        problem.folder: (name, problem)
        for name in options.objects
        for resolution in options.resolutions
        for problem in [
            make_problem(
                name, resolution, shadow_only=options.shadow_only, normals=options.normals_of(name), work=out / "objects"
            )
        ]
    }
    searches = {
        folder: choose(problem, name, options.samples, options.blur, options.tries, options.optimiser)
        for folder, (name, problem) in problems.items()
    }
    if len(problems) != len(options.objects) * len(options.resolutions):
        raise ShadowmapError(f"two of the objects {', '.join(options.objects)} have the same name: rename one file.")
    if options.scheduler == "local":
        if options.threads:
            dr.set_thread_count(options.threads)
    else:
        stored += _sweep(problems, searches, options, stored, console)

    result: list[dict[str, Any]] = []
    with io_console.progress(console) as progress:
        for folder, (_, problem) in problems.items():
            search = searches[folder]
            make = searching(search, options.iterations) if build is build_method else build
            kind = "path-traced reference" if options.reference == "mitsuba" else "reference"
            say = functools.partial(progress.console.print, highlight=False, soft_wrap=True, markup=False)
            with io_console.task(progress, f"{problem.folder} {kind}"):
                reference = _reference(problem, options, make)
            say(f"{problem.folder} {kind}: {out / problem.folder / 'reference.png'}")
            # Built once for all runs: compiled kernels are reused, and a method that cannot be built fails at once.
            methods: dict[str, Method] = {}
            for name in options.methods:
                with io_console.task(progress, f"{problem.folder} {name}: scene and kernels"):
                    methods[name] = make(name, problem, reference)
                    if len(methods) == 1:
                        say(_start(problem, name, methods[name], options))
            for method in methods.values():
                if fairness(method, problem).get("fair") is False:
                    note = "sample counts found with another object or resolution; that they converge here has not been shown"
                    say(f"{problem.folder} mitsuba: {note}: {getattr(method, 'setting', '')}")
            records: list[dict[str, Any]] = []
            images: dict[str, dict[str, Image]] = {}
            for run in range(options.runs):
                for name in options.methods:
                    title = f"{problem.folder} {name} run {run}"
                    if run == 0 and (about := described(methods[name], problem, options.iterations)):
                        if images:
                            picture = _picture(problem, options, records, images, reference, methods)
                            say(f"{problem.folder} picture so far: {picture}")
                        say(f"{title} begins: {about}")
                    task = progress.add_task(title, total=options.iterations, note="kernels are compiled")
                    step = RunSteps(progress, task, title, options.iterations, say)
                    record = _run_one(problem, name, run, options, methods[name], reference, stored, step)
                    record = {**record, "found": record["recovered"], "search": _search_record(search, options)}
                    record["reasons"] = reasons(record, problem)
                    final = record["final"] if None not in record["final"] else start_pose(options.seed, run)
                    pictures = _pictures(methods[name], record["start"], final, reference)
                    for part, image in pictures.items():
                        io_images.write_png(out / problem.folder / f"{name}-run{run}-{part}.png", image)
                    if run == 0:
                        images[name] = pictures
                    records.append(record)
                    stored = [*(other for other in stored if _key(other) != _key(record)), record]
                    io_records.write_json(out / "pose.json", {**header(options.settings), "runs": stored})
                    _remove_checkpoints(problem, name, run, options)
                    progress.remove_task(task)
                    say(f"{title}: {_outcome(record)}")
            with io_console.task(progress, f"{problem.folder} pictures"):
                _plots(problem, options, records, images, reference)
                _picture(problem, options, records, images, reference, methods)
            result += records
    return result


def pictures_of(options: PoseOptions) -> list[Path]:
    """Pictures of all methods that `run_pose` writes, one for each object and resolution."""
    objects = [(name if name in assets.mesh_names() else Path(name).stem, options.normals_of(name)) for name in options.objects]
    return [
        options.out / folder_name(name, size, options.shadow_only, normals) / _PICTURE
        for name, normals in objects
        for size in options.resolutions
    ]


def table(records: Sequence[dict[str, Any]]) -> Table:
    """Table of mean errors and times over the runs: a row for each object, resolution and method (the paper's Table 1)."""
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
    return io_console.table("Poses found, mean rotation error in degrees, mean offset error x 100, times", columns, rows)


def _identity(problem: PoseProblem, name: str, run: int, options: PoseOptions, method: Method) -> dict[str, Any]:
    seed, iterations, reference = options.seed, options.iterations, options.reference
    return identity(problem, name, run, method, seed=seed, iterations=iterations, reference=reference)


def _run_one(
    problem: PoseProblem,
    name: str,
    run: int,
    options: PoseOptions,
    method: Method,
    reference: Image,
    stored: Sequence[dict[str, Any]],
    on_step: Callable[[int, int], None],
) -> dict[str, Any]:
    """The record of a run: the stored record with exactly these settings if there is one, else that of a new run."""
    wanted = _identity(problem, name, run, options, method)
    for record in stored:
        if is_of(record, wanted):
            return record
    if not options.resume:
        _remove_checkpoints(problem, name, run, options)
    return make_record(method, reference, wanted, _checkpoint(problem, name, run, options), on_step)


def _sweep(
    problems: Mapping[str, tuple[str, PoseProblem]],
    searches: Mapping[str, Search],
    options: PoseOptions,
    stored: Sequence[dict[str, Any]],
    console: Console,
) -> list[dict[str, Any]]:
    """Make the runs without stored records with the workers of a scheduler. Returns their records."""
    missing = []
    for folder, (object_, problem) in problems.items():
        build = searching(searches[folder], options.iterations)
        # For the workers; those that do not see this folder make the reference again.
        with io_console.progress(console) as progress, io_console.task(progress, f"{folder} reference"):
            reference = _reference(problem, options, build)
        for name in options.methods:
            method = build(name, problem, reference)
            wanted = [_identity(problem, name, run, options, method) for run in range(options.runs)]
            numbers = [run for run, own in enumerate(wanted) if not any(is_of(record, own) for record in stored)]
            missing.append(
                PoseRuns(
                    object=object_ if object_ == problem.name else str(Path(object_).resolve()),
                    folder=folder,
                    resolution=problem.resolution,
                    method=name,
                    numbers=tuple(numbers),
                    iterations=options.iterations,
                    seed=options.seed,
                    reference=options.reference,
                    shadow_only=options.shadow_only,
                    normals=problem.normals,
                    search=searches[folder],
                    out=str(options.out.resolve()),
                )
            )
    found = run_sweep(
        [runs for runs in missing if runs.numbers],
        options.out,
        scheduler=options.scheduler,
        variant=mi.variant(),
        threads=options.threads,
        resume=options.resume,
        console=console,
    )
    return [record for records in found.values() for record in records]


def _search_record(search: Search, options: PoseOptions) -> dict[str, Any]:
    """Settings of a search for the record, and the names of those that the user left to us."""
    chosen = [name for name in ("samples", "blur", "tries") if getattr(options, name) is None]
    return {**dataclasses.asdict(search), "chosen": chosen}


def _reference(problem: PoseProblem, options: PoseOptions, build: Builder) -> Image:
    folder = options.out / problem.folder
    image = make_reference(problem, options.reference, folder, build)
    io_images.write_png(folder / "reference.png", image)
    return image


def _pictures(method: Method, start: npt.ArrayLike, final: npt.ArrayLike, reference: Image) -> dict[str, Image]:
    result = method.render(final)
    return {"start": method.render(start), "result": result, "difference": np.abs(result - reference)}


def _start(problem: PoseProblem, name: str, method: Method, options: PoseOptions) -> str:
    """Write the picture of the first run's start. Returns a line about it."""
    start, path = start_pose(options.seed, 0), options.out / problem.folder / f"{name}-run0-start.png"
    io_images.write_png(path, method.render(start))
    rotation, offset = pose_errors(start)
    return f"{problem.folder} start, {rotation:.1f} degrees and {offset / 100:.2f} units off: {path}"


def _picture(
    problem: PoseProblem,
    options: PoseOptions,
    records: Sequence[dict[str, Any]],
    images: Mapping[str, Mapping[str, Image]],
    reference: Image,
    methods: Mapping[str, Method],
) -> Path:
    """Write the picture of a problem, of the methods that have made a run. Returns its path."""
    courses = {
        name: Course(shown["start"], shown["result"], [record for record in records if record["method"] == name])
        for name, shown in images.items()
    }
    seen = "its shadow" if problem.shadow_only else "it and its shadow"
    heading = f"{problem.name[:1].upper()}{problem.name[1:]}: its pose, found from one image of {seen}"
    shading = "Smooth shading" if problem.normals == "vertex" else "Flat shading"
    steps = f"All methods take {options.iterations} steps of Adam with the same step size; none is cut short"
    dots = "" if options.runs > 1 else " Dots: from here on the run stays at the pose."
    notes = [f"{shading}, {dr.thread_count()} threads. {steps}.{dots}"]
    if "mitsuba" in courses and hasattr(methods["mitsuba"], "setting"):
        notes.append(f"Mitsuba: {setting_text(methods['mitsuba'], problem)}.")
    path = options.out / problem.folder / _PICTURE
    draw(path, heading, reference, courses, notes)
    return path


def _plots(
    problem: PoseProblem,
    options: PoseOptions,
    records: Sequence[dict[str, Any]],
    images: dict[str, dict[str, Image]],
    reference: Image,
) -> None:
    panels = {
        "rotation error [degrees]": "rotation_error_curve",
        "offset error [units / 100]": "translation_error_curve",
        "loss (mean squared difference)": "loss_curve",
    }
    curves = {
        label: {name: [record[key] for record in records if record["method"] == name] for name in options.methods}
        for label, key in panels.items()
    }
    note = "Curves of one colour are runs from different starts."
    plots.plot_curves(options.out / problem.folder / "convergence.png", curves, caption=note)
    rows = {name: {"reference": reference, **pictures} for name, pictures in images.items()}
    plots.image_sheet(options.out / problem.folder / "images.png", rows)


def _checkpoint(problem: PoseProblem, name: str, run: int, options: PoseOptions) -> Path:
    return options.out / problem.folder / f"{name}-run{run}-seed{options.seed}.checkpoint.npz"


def _remove_checkpoints(problem: PoseProblem, name: str, run: int, options: PoseOptions) -> None:
    path = _checkpoint(problem, name, run, options)
    for one in path.parent.glob(f"{glob.escape(path.stem)}*{path.suffix}"):
        one.unlink(missing_ok=True)


def _key(record: dict[str, Any]) -> tuple[Any, ...]:
    """Identity of a record's run: a newer record with the same key replaces it."""
    names = ("object", "resolution", "method", "run", "seed", "iterations", "reference", "shadow_only")
    settings = record.get("settings", {})
    search = (settings.get("samples_per_pixel", 1), settings.get("blur", 0), settings.get("tries", 1))
    variant = record.get("variant", record.get("environment", {}).get("variant"))
    return (*(record.get(name) for name in names), search, _normals(record), variant)


def _normals(record: dict[str, Any]) -> str:
    """Kind of normals of a record; records of earlier versions are of flat shading."""
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
    total = _mean([record], "seconds_total", "{:.1f}")
    text = "rotation {} deg, offset x 100 {}, {} s per iteration, {} s in all".format(*values, time, total)
    return text if record["recovered"] else f"{text}; not found: {'; '.join(record['reasons'])}"

"""Faces from profile shadows: weights of a morphable model are fitted to the shadow of a head, or to a silhouette."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import Progress, TaskID

from ...errors import ShadowmapError, did_you_mean
from ...inverse import History, optimize
from ...inverse.faces.morph_fit import MorphFit
from ...inverse.faces.morphable import MorphableModel
from ...io import console as io_console
from ...io import files, records
from ...io.machine import header
from ...io.options import option, setting
from ...io.ranges import FILTER_SIDE, MAP_SIDE, SAMPLES, SEED, SIDE, STEPS, check_ranges
from . import pictures as faces_pictures
from . import report as faces_report
from .information import image_derivatives, posterior_covariance, recovery
from .metrics import check_libraries, surface_distance
from .problem import LIGHTS, MODES, FaceScene, FloatArray, Mode, artificial_weights, default_model, path_traced_shadow

SEEDS = (1, 6, 8, 131)
#: Strength of the prior. A tenth and three times as much change the mean errors of the four heads by less than a tenth
#: (docs/faces.md).
PRIOR = 3e-5
STEP_SIZE, TRANSLATION_STEP = 0.2, 0.01
Reference = Literal["own", "mitsuba"]


@dataclass(frozen=True)
class FaceOptions:
    """Options of a run. Everything is run for each mode, number of shadows and head.

    For ``modes`` see `faces.problem.MODES`, for ``prior`` see `MorphFit`.
    """

    seeds: tuple[int, ...] = option(SEEDS, names=("--head",), allowed=SEED, help="Seed of an artificial head; repeatable.")
    lights: tuple[int, ...] = option(
        LIGHTS,
        names=("--shadows",),
        choices=map(str, LIGHTS),
        shown="both",
        allowed=(1, 3),
        help="Number of shadows; repeatable.",
    )
    modes: tuple[Mode, ...] = option(
        ("identity",),
        names=("--mode",),
        help="Unknowns: identity, identity and expression, or expression of a known head; repeatable.",
    )
    prior: float = option(
        PRIOR, shown="3e-5, 3e-4 with --image", allowed=(0.0, 1e6), help="Strength of the prior on the weights, 0 for none."
    )
    model: Path | None = option(None, shown="the head of this package", help="Morphable model (.npz).")
    iterations: int = option(400, allowed=STEPS, help="Steps of the optimiser.")
    translate: bool = option(False, help="Fit the head's position, too (always with --image).")
    reference: Reference = option("own", help="Target shadows: rendered by this library, or path-traced.")
    height: int = option(192, allowed=SIDE, help="Rows of the shadow image.")
    map_resolution: int = option(256, allowed=MAP_SIDE, help="Texels along each side of a shadow map.")
    filter_size: int = option(3, allowed=FILTER_SIDE, help="Texels along each side of the filter.")
    out: Path = option(Path("face"), help="Folder for the results.")
    resume: bool = option(False, help="Keep finished runs, resume killed ones.")
    spp: int = setting(512, allowed=SAMPLES, help="Samples per pixel of path-traced images.")
    samples: int = setting(30_000, allowed=(100, 10_000_000), help="Points on each surface from which distances are measured.")

    def __post_init__(self) -> None:
        check_ranges(self)
        for name, values, known in (
            ("head", self.seeds, None),
            ("number of shadows", self.lights, LIGHTS),
            ("mode", self.modes, MODES),
        ):
            if not values:
                raise ShadowmapError(f"no {name} given: name at least one.")
            for value in values:
                if known is not None and value not in known:
                    raise ShadowmapError(
                        f"no {name} {value!r}: choose from {', '.join(map(str, known))}.{did_you_mean(value, known)}"
                    )
                if values.count(value) > 1:
                    raise ShadowmapError(f"the {name} {value} is given twice: name each once.")
        if self.reference not in ("own", "mitsuba"):
            raise ShadowmapError(f"no reference {self.reference!r}: choose own or mitsuba.")


@dataclass(frozen=True)
class Head:
    """An artificial head: its seed, weights (K,) and (E,), vertices (V, 3), and the vertices from which a fit starts."""

    seed: int
    identity: npt.NDArray[np.float64]
    expression: npt.NDArray[np.float64]
    vertices: FloatArray
    start: FloatArray

    @classmethod
    def make(cls, model: MorphableModel, seed: int, mode: Mode) -> Head:
        identity, expression = artificial_weights(model, seed, mode)
        start = model.vertices(identity) if mode == "expression" else model.mean
        return cls(seed, identity, expression, model.vertices(identity, expression), start)

    def weights(self, mode: Mode) -> npt.NDArray[np.float64]:
        """The true weights of the head, as far as a fit of this mode looks for them."""
        return {"identity": self.identity, "expression": self.expression}.get(
            mode, np.concatenate([self.identity, self.expression])
        )


def run_faces(options: FaceOptions, *, console: Console | None = None) -> dict[str, Any]:
    """Run the experiment and write its results below `options.out`.

    Files: `faces.json` (settings and a record for each run), `faces.md` (tables), for each mode `MODE-profiles-1.png` and
    `-3.png` (shadows), `MODE-errors.png` (distances drawn on the heads), `convergence.png`, heads as `.ply`. Returns the record.
    """
    check_libraries()
    console = console or io_console.notes()
    path = files.check_output(options.out / "faces.json", (".json",))
    model = default_model(options.model)
    scenes = {
        lights: FaceScene.build(model, lights, options.height, options.map_resolution, options.filter_size)
        for lights in options.lights
    }
    record = _started(path, options, model)
    with io_console.progress(console) as progress:
        task = progress.add_task("heads", total=len(options.modes) * len(options.lights) * len(options.seeds), note="")
        for mode in options.modes:
            sheets = faces_pictures.Sheets(model, mode)
            for seed in options.seeds:
                head = Head.make(model, seed, mode)
                for lights in options.lights:
                    progress.update(task, note=f"{mode}, head {seed}, {lights} shadow{'s' * (lights > 1)}")
                    _one(scenes[lights], head, mode, options, record, path, progress, sheets)
                    progress.advance(task)
            sheets.write(options.out)
    faces_report.write(options.out, record)
    return record


def _one(
    scene: FaceScene,
    head: Head,
    mode: Mode,
    options: FaceOptions,
    record: dict[str, Any],
    path: Path,
    progress: Progress,
    sheets: faces_pictures.Sheets,
) -> None:
    """Run a fit unless its record is known; store the record and the pictures."""
    key = f"{mode} | {scene.lights} | {head.seed}"
    if options.reference == "own":
        target = scene.shadow(head.vertices)
    else:
        target = path_traced_shadow(scene, head.vertices, options.spp)
    fit = scene.fit(
        mode,
        target,
        identity=head.identity,
        prior=options.prior,
        translate=options.translate,
        step_size=STEP_SIZE,
        translation_step=TRANSLATION_STEP,
    )
    if key not in record["runs"]:
        checkpoint = options.out / "checkpoints" / f"{mode}-{scene.lights}-{head.seed}.npz"
        if not options.resume:
            checkpoint.unlink(missing_ok=True)
        start = np.zeros(fit.count + (2 if options.translate else 0))
        steps = progress.add_task("steps", total=options.iterations, note="")
        show = functools.partial(_show, progress, steps)
        settings = {**record["settings"], "run": key}
        history = optimize(fit, start, options.iterations, checkpoint=checkpoint, settings=settings, on_step=show)
        progress.remove_task(steps)
        record["runs"][key] = _measured(scene, head, mode, options, fit, history)
        records.write_record(path, record, "runs")
        checkpoint.unlink(missing_ok=True)
    final = np.array(record["runs"][key]["final"], np.float64)
    found = fit.vertices(final)
    faces_pictures.write_ply(options.out / "heads" / f"{mode}-{head.seed}-{scene.lights}.ply", found, scene.model.faces)
    sheets.add(
        head.seed,
        scene.lights,
        head.vertices,
        head.start,
        found,
        target[..., None],
        fit.render(np.zeros_like(final)),
        fit.render(final),
    )


def _measured(scene: FaceScene, head: Head, mode: Mode, options: FaceOptions, fit: MorphFit, history: History) -> dict[str, Any]:
    faces, mask = scene.model.faces, scene.model.mask
    found, true = fit.vertices(history.final), np.asarray(head.weights(mode))
    weights = history.final[: fit.count]
    difference = fit.render(history.final)[..., 0] - np.array(fit.reference)
    result: dict[str, Any] = {
        "mode": mode,
        "lights": scene.lights,
        "seed": head.seed,
        "distance": vars(surface_distance(found, head.vertices, faces, mask, samples=options.samples)),
        "start_distance": vars(surface_distance(head.start, head.vertices, faces, mask, samples=options.samples)),
        "image_error": float(np.sqrt(np.mean(np.square(difference)))),
        "weight_error": float(np.sqrt(np.mean(np.square(weights - true)))),
        "seconds_per_iteration": history.seconds_per_iteration,
        "seconds_total": history.seconds_total,
        "final": history.final,
        "true": true,
        "loss_curve": history.loss,
    }
    if mode == "expression" and options.prior > 0:
        left = posterior_covariance(image_derivatives(fit, np.zeros(len(history.final))), options.prior)
        result["recovery"] = recovery(scene.model.expression_names, left, true, weights)
    return records.plain(result)


def _started(path: Path, options: FaceOptions, model: MorphableModel) -> dict[str, Any]:
    """The stored record of a call with the same settings if the run is resumed, else an empty one."""
    settings = records.plain(
        {
            "model": faces_report.digest(model),
            "iterations": options.iterations,
            "prior": options.prior,
            "translate": options.translate,
            "reference": options.reference,
            "spp": options.spp if options.reference != "own" else None,
            "height": options.height,
            "map_resolution": options.map_resolution,
            "filter_size": options.filter_size,
            "samples": options.samples,
            "step_size": STEP_SIZE,
            "translation_step": TRANSLATION_STEP,
        }
    )
    record: dict[str, Any] = {**header(settings), "runs": {}}
    if options.resume and path.exists():
        needed = (
            "mode",
            "lights",
            "seed",
            "distance",
            "start_distance",
            "image_error",
            "weight_error",
            "final",
            "true",
            "loss_curve",
        )
        return records.read_record(path, record, {"runs": needed}, _report)
    return record


def _report(record: dict[str, Any]) -> None:
    """Make what is written of the runs, for its errors."""
    faces_report.reading(record)
    faces_report.tables(record)
    for run in record["runs"].values():
        np.asarray(run["loss_curve"], np.float64)


def _show(progress: Progress, task: TaskID, done: int) -> None:
    progress.update(task, completed=done)

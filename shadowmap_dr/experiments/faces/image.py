"""Fit of a head to a silhouette in an image file."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import Progress, TaskID

from ...inverse import optimize
from ...io import console as io_console
from ...io import files, plots, records
from ...io.machine import header
from ...io.options import setting
from ...io.ranges import FILTER_SIDE, MAP_SIDE, SIDE, STEPS, check_ranges
from . import pictures as faces_pictures
from . import report as faces_report
from .experiment import STEP_SIZE, TRANSLATION_STEP, FaceOptions
from .problem import FaceScene, Mode, default_model
from .silhouette import place, read_silhouette, resample

#: Ten times as strong as for artificial heads: no head of the model casts exactly the silhouette of another source.
PRIOR = 3e-4
# Doubts about a picture: rarer weights, larger differences of the shadows.
_LEAST_CHANCE, _MOST_ERROR = 1e-3, 0.1


@dataclass(frozen=True)
class ImageOptions:
    """A silhouette and options of its fit; attributes not listed are those of `faces.FaceOptions`.

    Attributes:
        image: file; the background may be white, black or transparent.
        mode: ``identity`` or ``both``.
    """

    image: Path
    mode: Mode = "identity"
    model: Path | None = FaceOptions.model
    iterations: int = setting(FaceOptions.iterations, help="Steps of the optimiser.", allowed=STEPS)
    prior: float = setting(PRIOR, help="Strength of the prior on the weights.", allowed=(0.0, 1e6))
    height: int = setting(FaceOptions.height, help="Rows of the shadow image.", allowed=SIDE)
    map_resolution: int = setting(FaceOptions.map_resolution, help="Texels along each side of a shadow map.", allowed=MAP_SIDE)
    filter_size: int = setting(FaceOptions.filter_size, help="Texels along each side of the filter.", allowed=FILTER_SIDE)
    out: Path = FaceOptions.out
    resume: bool = FaceOptions.resume

    def __post_init__(self) -> None:
        check_ranges(self)


def chance_of_weights(weights: npt.ArrayLike) -> float:
    """Share of heads of the model whose weights are as far from the mean head's as these, 0 to 1.

    Weights of a model are standard normal, so that the sum of K squares has a chi-square distribution. Its cube root is nearly
    normal (E. B. Wilson and M. M. Hilferty, "The distribution of chi-square", PNAS, 1931).
    """
    values = np.asarray(weights, np.float64).ravel()
    spread = 2 / (9 * max(values.size, 1))
    z = (np.cbrt(np.square(values).mean() if values.size else 1.0) - (1 - spread)) / math.sqrt(spread)
    return 0.5 * math.erfc(z / math.sqrt(2))


def doubts(record: dict[str, Any]) -> list[str]:
    """Reasons why the picture of a record may show no head of the model, with what to try."""
    result, chance, error = [], record["chance_of_weights"], record["image_error"]
    if chance < _LEAST_CHANCE:
        size = float(np.sqrt(np.mean(np.square(record["weights"]))))
        result.append(
            f"the head is unlikely: one of {1 / max(chance, 1e-9):.0e} heads or fewer has such weights (root mean square "
            f"{size:.1f} standard deviations); give a profile silhouette, or a larger --prior."
        )
    if error > _MOST_ERROR:
        result.append(
            f"the shadow of the head differs from the picture (root mean square {error:.2f}): give a profile silhouette of a "
            "head, dark on light."
        )
    return result


def run_image(options: ImageOptions, *, console: Console | None = None) -> dict[str, Any]:
    """Fit a head and its position to the silhouette. Returns the record.

    Writes into `options.out`, with the image's name as prefix: `-face.json`, `-shadows.png` (the silhouette, aligned with the
    shadow of the mean head; that shadow; the result), `-heads.png`, `-face.ply`.
    """
    console = console or io_console.notes()
    name = options.image.stem
    path = files.check_output(options.out / f"{name}-face.json", (".json",))
    silhouette = read_silhouette(options.image)
    model = default_model(options.model)
    scene = FaceScene.build(model, 1, options.height, options.map_resolution, options.filter_size)
    placement = place(silhouette, scene.shadow(model.mean))
    target = resample(silhouette, scene.shadows.shape, placement)
    fit = scene.fit(
        options.mode, target, translate=True, prior=options.prior, step_size=STEP_SIZE, translation_step=TRANSLATION_STEP
    )
    settings = records.plain(
        {
            "image": options.image.name,
            "mode": options.mode,
            "model": faces_report.digest(model),
            "iterations": options.iterations,
            "height": options.height,
            "map_resolution": options.map_resolution,
            "filter_size": options.filter_size,
            "placement": vars(placement),
            **fit.describe(),
        }
    )
    checkpoint = options.out / "checkpoints" / f"{name}.npz"
    if not options.resume:
        checkpoint.unlink(missing_ok=True)
    start = np.zeros(fit.count + 2)
    with io_console.progress(console) as progress:
        task = progress.add_task("steps", total=options.iterations, note="")
        show = functools.partial(_show, progress, task)
        history = optimize(fit, start, options.iterations, checkpoint=checkpoint, settings=settings, on_step=show)
    images = {"target": target[..., None], "mean head": fit.render(start), "result": fit.render(history.final)}
    images["difference"] = np.abs(images["result"] - images["target"])
    record = records.plain(
        {
            **header(settings),
            "image_error": float(np.sqrt(np.mean(images["difference"] ** 2))),
            "image_error_start": float(np.sqrt(np.mean(np.square(images["mean head"] - images["target"])))),
            "weights": history.final[: fit.count],
            "chance_of_weights": chance_of_weights(history.final[: fit.count]),
            "translation": history.final[fit.count :],
            "seconds_per_iteration": history.seconds_per_iteration,
            "loss_curve": history.loss,
        }
    )
    records.write_json(path, record)
    found = fit.vertices(history.final)
    heads = {"mean head": model.mean, "result": found}
    drawn = {title: faces_pictures.picture(vertices, model.faces, model.mask) for title, vertices in heads.items()}
    plots.image_sheet(options.out / f"{name}-shadows.png", {"shadow": images})
    plots.image_sheet(options.out / f"{name}-heads.png", {"head": drawn})
    faces_pictures.write_ply(options.out / f"{name}-face.ply", found, model.faces)
    checkpoint.unlink(missing_ok=True)
    return record


def _show(progress: Progress, task: TaskID, done: int) -> None:
    progress.update(task, completed=done)

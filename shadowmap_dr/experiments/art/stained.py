"""Stained glass: a sheet of tinted panes whose coloured shadow on a floor is a given picture.

Protocol: grey panes at first, 200 steps; root mean square difference of linear colours, 0..1, between the floor and the picture.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table

from ...inverse.runs.loop import WARM_UP_STEPS
from ...inverse.shadow_art.stained import StainedSheet, description, scene_text
from ...io import animations, assets, files, records
from ...io import console as io_console
from ...io import images as io_images
from ...io.animations import Pixels
from ...io.checkpoints import read_checkpoint, unreadable, write_checkpoint
from ...io.machine import header
from ...io.pictures import read_picture
from ...io.resampling import area_average
from ...rendering.renderer import Renderer
from .experiment import ArtOptions
from .pictures import LAST_MS
from .run import CHECKPOINT_INTERVAL, LOOK_INTERVAL, frame_steps

#: Larger root mean square differences are worth a warning.
GOOD = 0.05
# Least side of a pane in pixels of `sheet.png`'s longer side, and texels of the map of pictures from the side.
_SHEET_SIDE, _MAP_RESOLUTION = 512, 1024
# Origin, target, field of view (degrees) and exposure of the picture from the side.
_ORIGIN, _TARGET, _FOV, _EXPOSURE = (2.5, 9.5, 7.0), (-1.6, 1.4, 0.0), 34.0, 0.75

Array = npt.NDArray[np.float32]


@dataclass
class Course:
    """Course of a run.

    Attributes:
        loss: before each step, mean squares.
        seconds: wall-clock time of each step.
        looks: pairs of a step and the root mean square difference after it.
        frames: pairs of a step and the floor (H, H, 3), sRGB, after it.
    """

    loss: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    looks: list[tuple[int, float]] = field(default_factory=list)
    frames: list[tuple[int, Pixels]] = field(default_factory=list)


def read_square(name: str, size: int) -> Array:
    """The middle square of a picture, as linear colours (size, size, 3); what is transparent is dark.

    ``name``: a file, or a picture of this package.
    """
    pixels = read_picture(assets.target(name))
    side = min(pixels.shape[:2])
    top, left = (pixels.shape[0] - side) // 2, (pixels.shape[1] - side) // 2
    square = pixels[top : top + side, left : left + side]
    linear = np.asarray(io_images.to_linear(square[..., :3]) * square[..., 3:], np.float32)
    return np.clip(area_average(lambda rows: linear[rows], (side, side), (size, size)), 0, 1)


def run_stained(options: ArtOptions, *, console: Console | None = None) -> dict[str, Any]:
    """Make one sheet, write all files into ``options.out``, and return the record of `art.json`."""
    assert options.stained is not None and options.iterations is not None
    steps = options.iterations
    if options.threads:
        dr.set_thread_count(options.threads)
    path = files.check_output(options.out / "art.json", (".json",))
    checkpoint = options.out / "checkpoint.npz"
    if not options.resume:
        checkpoint.unlink(missing_ok=True)
    picture = read_square(options.stained, options.resolution)
    sheet = StainedSheet(picture, panes=options.panes, map_resolution=options.map_resolution or 0)
    io_images.write_png(options.out / "target-1.png", picture)  # before the long part: what was understood of the picture
    settings = {"stained": Path(options.stained).name, "iterations": steps, **sheet.describe()}
    fingerprint = json.dumps([records.plain(settings), float(np.square(picture - 0.3).sum(dtype=np.float64))], sort_keys=True)
    with io_console.progress(console or io_console.notes()) as progress:
        task = progress.add_task("steps", total=steps, note="kernels are compiled")
        course = make_sheet(
            sheet, steps, checkpoint, fingerprint, lambda done, note: progress.update(task, completed=done, note=note)
        )
        record = records.plain({**header(settings), **_results(sheet, course)})
        record["files"] = _write(options, sheet, course)
    record["warnings"] = _warnings(record)
    records.write_json(path, record)
    checkpoint.unlink(missing_ok=True)
    return record


def make_sheet(
    sheet: StainedSheet,
    iterations: int,
    checkpoint: Path | None = None,
    fingerprint: str = "",
    on_step: Callable[[int, str], None] = lambda done, note: None,
) -> Course:
    """Run a number of steps.

    Args:
        sheet: at its start.
        iterations: number of steps, from 1 on.
        checkpoint: file that is written every 50 steps, and from which the run resumes if it exists.
        fingerprint: identifies the run; a checkpoint with another one is an error.
        on_step: called with the number of finished steps and a text about the accuracy.

    Raises ShadowmapError if the checkpoint belongs to another run, cannot be read, or cannot be written.
    """
    wanted, note = frame_steps(iterations), ""
    course = Course() if checkpoint is None or not checkpoint.exists() else _resumed(sheet, checkpoint, fingerprint)
    if not course.frames:
        course.frames.append((0, _pixels(sheet.picture())))
    for done in range(len(course.loss) + 1, iterations + 1):
        began = time.perf_counter()
        loss = sheet.step()
        dr.sync_thread()
        course.seconds.append(time.perf_counter() - began)
        course.loss.append(float(np.asarray(loss).reshape(-1)[0]))
        if done % LOOK_INTERVAL == 0 or done == iterations:
            course.looks.append((done, difference(sheet)))
            note = f"RMSE {course.looks[-1][1]:.4f}"
        if done in wanted:
            course.frames.append((done, _pixels(sheet.picture())))
        if checkpoint is not None and (done % CHECKPOINT_INTERVAL == 0 or done == iterations):
            _save(checkpoint, fingerprint, sheet, course)
        on_step(done, note)
    return course


def difference(sheet: StainedSheet) -> float:
    """Root mean square difference between the floor and the picture."""
    return float(np.sqrt(np.square(sheet.picture() - sheet.target()).mean(dtype=np.float64)))


def _save(path: Path, fingerprint: str, sheet: StainedSheet, course: Course) -> None:
    arrays: dict[str, Any] = {f"state/{name}": array for name, array in sheet.state().items()}
    arrays |= {"loss": np.array(course.loss), "seconds": np.array(course.seconds), "looks": np.array(course.looks)}
    arrays["frames"], arrays["frame_steps"] = (np.array([frame[k] for frame in course.frames]) for k in (1, 0))
    write_checkpoint(path, fingerprint, arrays)


def _resumed(sheet: StainedSheet, path: Path, fingerprint: str) -> Course:
    arrays = read_checkpoint(path, fingerprint)
    try:
        sheet.load_state({name.removeprefix("state/"): one for name, one in arrays.items() if name.startswith("state/")})
        looks = [(int(step), float(value)) for step, value in arrays["looks"].tolist()]
        frames = list(zip(arrays["frame_steps"].tolist(), arrays["frames"], strict=True))
        return Course(arrays["loss"].tolist(), arrays["seconds"].tolist(), looks, frames)
    except (KeyError, ValueError, TypeError) as error:
        raise unreadable(path) from error


def _results(sheet: StainedSheet, course: Course) -> dict[str, Any]:
    warm = course.seconds[WARM_UP_STEPS:] or course.seconds
    return {
        "rmse": difference(sheet),
        "seconds_per_iteration": float(np.median(warm)),
        "seconds": float(sum(course.seconds)),
        "rmse_curve": {"step": [step for step, _ in course.looks], "rmse": [value for _, value in course.looks]},
        "loss_curve": course.loss[::10],
    }


def _write(options: ArtOptions, sheet: StainedSheet, course: Course) -> list[str]:
    """Write all files except the record. Returns their names."""
    out, tints, floor, target = options.out, sheet.tints(), sheet.picture(), sheet.target()
    times = max(1, _SHEET_SIDE // len(tints))
    pictures = {
        "shadow-1.png": floor, "target-1.png": target, "error-1.png": 0.5 + 0.5 * (floor - target),
        "sheet.png": tints.repeat(times, axis=0).repeat(times, axis=1), "sheet.exr": tints,
        "picture.png": _from_the_side(tints, sheet.panes, 2 * options.picture_size),
    }  # fmt: skip
    for name, pixels in pictures.items():
        io_images.write_image(out / name, pixels)
    with files.atomic(out / "sheet.xml") as temporary:
        temporary.write_text(scene_text("sheet.exr", sheet.panes, len(tints), len(target)), encoding="utf-8")
    names = [*pictures, "sheet.xml"]
    if options.animate is not None:
        names.append("steps" + options.animate)
        animations.write_animation(out / names[-1], [pixels for _, pixels in course.frames], last_ms=LAST_MS)
    return names


def _from_the_side(tints: Array, panes: int, size: int) -> Array:
    """The sheet above the floor and its shadow, (size, size, 3), linear."""
    scene = description(tints, panes, size)
    place = mi.ScalarTransform4f().look_at(list(_ORIGIN), list(_TARGET), [0, 1, 0])
    scene["camera"] |= {"type": "perspective", "fov": _FOV, "to_world": place}
    renderer = Renderer.from_scene(mi.load_dict(scene, optimize=False), shadow_map_resolution=_MAP_RESOLUTION)
    with dr.suspend_grad():
        return _EXPOSURE * np.array(renderer.render(spp=4), np.float32)[..., :3]


def _pixels(image: Array) -> Pixels:
    return np.round(255 * io_images.to_srgb(np.clip(image, 0, 1))).astype(np.uint8)


def _warnings(record: dict[str, Any]) -> list[str]:
    if record["rmse"] <= GOOD:
        return []
    settings = record["settings"]
    advice = "the picture has details smaller than panes; try more --panes"
    if settings["map_resolution"] < 4 * settings["panes"]:
        advice = "panes have less than four texels; try a larger --map-resolution"
    return [f"{settings['stained']}: the floor differs by {record['rmse']:.3f}: {advice}."]


def table(record: dict[str, Any]) -> Table:
    """Table for the terminal."""
    settings = record["settings"]
    panes = settings["panes"] + 2 * settings["border_panes"]
    row = [settings["stained"], f"{panes} x {panes}", f"{np.sqrt(record['loss_curve'][0]):.4f}", f"{record['rmse']:.4f}"]
    return io_console.table("Floor and picture: root mean square difference", ["picture", "panes", "start", "end"], [row])


def summary(record: dict[str, Any]) -> str:
    """Times, in one line."""
    each = 1000 * record["seconds_per_iteration"]
    return f"{record['settings']['iterations']} steps in {record['seconds']:.1f} s ({each:.1f} ms each)"

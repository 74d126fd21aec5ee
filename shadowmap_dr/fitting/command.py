"""A fit with its files: the work of the command `shadowmap-dr fit`."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

import mitsuba as mi
from rich.console import Console
from rich.progress import Progress

from ..errors import ShadowmapError, warn
from ..io import console as io_console
from ..io import files
from ..rendering.renderer import Renderer
from .film import encode_film
from .glb import write_glb
from .report import write_report
from .result import FitResult, Step
from .scene_file import write_fitted_scene
from .search import Fit
from .task import FitTask
from .toml import to_toml

# Files in the folder of results.
RESULT, TASK, REPORT, FILM, MODEL, STATE = "fit.json", "fit.toml", "report.html", "film.webp", "scene.glb", "fit.npz"


def run_fit(
    task: FitTask,
    scene: mi.Scene,
    scene_file: Path,
    out: Path,
    *,
    resume: bool = False,
    console: Console | None = None,
) -> FitResult:
    """Fit a scene and write all results into a folder.

    Files: `fit.json`, `fit.toml` (the task), `report.html`, `film.webp`, the fitted scene as `scene.xml` with its files and as
    `scene.glb`, and `fit.npz`, from which a fit that was killed goes on.

    Args:
        task: the inputs.
        scene: the scene that was loaded from ``scene_file`` with the task's parameters and ``optimize=False``.
        out: folder of results.
        resume: go on from the results of a call with the same task that did not end.
        console: for progress.

    Raises:
        ShadowmapError: The task does not fit to the scene.
        OutputError: A file cannot be written.
    """
    console = console or io_console.notes()
    renderer = Renderer.from_scene(scene)
    fit = Fit(renderer, [picture.read() for picture in task.pictures], task.options, [p.exposure for p in task.pictures])
    steps = fit.steps(out / STATE, resume=resume)
    files.make_folder(out)
    (out / TASK).write_text(to_toml(_beside(task, out)), encoding="utf-8")
    with io_console.progress(console) as progress:
        number = progress.add_task("fit", total=None, note="recording the first images")
        for step in steps:
            progress.update(number, note=_words(step, fit))
    result = fit.result(shlex.join(["shadowmap-dr", *sys.argv[1:]]))
    result.settings = task.plain()
    with io_console.progress(console) as progress:
        _write(result, fit, task, scene_file, out, progress)
    (out / STATE).unlink(missing_ok=True)
    return result


def _words(step: Step, fit: Fit) -> str:
    """The state of a fit in words."""
    best = min((entry["error"] for entry in fit.history if entry["stage"] == step["stage"]), default=step["error"])
    return (
        f"images of {step['stage']}, start {step['start'] + 1}: off by {100 * step['error']:.0f} % of the picture's brightness, "
        f"{100 * best:.0f} % at best"
    )


def _write(result: FitResult, fit: Fit, task: FitTask, scene_file: Path, out: Path, progress: Progress) -> None:
    """Write the results; problems of single files become warnings, so that nothing is lost."""
    result.write_json(out / RESULT)
    with io_console.task(progress, "report and film"):
        film = encode_film(result.pictures) if any(picture.frames for picture in result.pictures) else None
        write_report(result, out / REPORT, film=film)
        if film is not None:
            with files.atomic(out / FILM) as temporary:
                temporary.write_bytes(film)
    with io_console.task(progress, "fitted scene"):
        _write_scene(fit, task, scene_file, out)


def _write_scene(fit: Fit, task: FitTask, scene_file: Path, out: Path) -> None:
    """Write the fitted scene, as XML and as glTF."""
    names = [key for key in mi.traverse(fit.renderer.data.scene).keys()]  # noqa: SIM118, C416
    try:
        written = write_fitted_scene(scene_file, dict(task.parameters), fit.changes(), out, names=names, copy_files=True)
    except ShadowmapError as error:
        warn(f"the fitted scene was not written: {error}")
        return
    for note in written.notes:
        warn(f"{written.files[0]}: {note}.")
    try:
        loaded = mi.load_file(str(written.files[0]), optimize=False)
        for note in write_glb(loaded, out / MODEL):
            io_console.note(f"{out / MODEL}: {note}.")
    except (ShadowmapError, RuntimeError) as error:
        io_console.note(f"{out / MODEL} was not written: {' '.join(str(error).split())}")


def _beside(task: FitTask, out: Path) -> dict[str, object]:
    """Entries of fit.toml with absolute names of files, which hold from any folder."""
    entries = task.plain()
    if task.scene.endswith(".xml"):
        entries["scene"] = str(Path(task.scene).resolve())
    for picture in entries["target"]:
        for name in ("file", "mask"):
            if name in picture:
                picture[name] = str(Path(picture[name]).resolve())
    return entries

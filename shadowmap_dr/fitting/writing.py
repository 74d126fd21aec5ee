"""Files of a result: numbers, report, film, and the fitted scene."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi

from ..errors import ShadowmapError, warn
from ..io import console, files
from ..jit.threads import second_thread
from .film import encode_film
from .glb import write_glb
from .report import write_report
from .result import FitResult
from .scene_file import write_fitted_scene

# Names of the files.
RESULT, REPORT, FILM, MODEL = "fit.json", "report.html", "film.webp", "scene.glb"


def write_fit(
    result: FitResult,
    folder: str | os.PathLike[str],
    scene: str | os.PathLike[str] | Mapping[str, Any] | None = None,
    parameters: Mapping[str, str] | None = None,
) -> list[Path]:
    """Write a result into a folder, as the command ``shadowmap-dr fit`` does.

    Files: ``fit.json``, ``report.html``, ``film.webp``, and the fitted scene: ``scene.xml`` with ``scene_files``, and
    ``scene.glb``. The fitted scene is the original file with the fitted values in it. A value or a file that cannot be written
    becomes a warning, so that the others are not lost.

    Args:
        result: of :func:`fit`, or of ``Fit.result``. One that was read from a file has neither pictures nor a scene.
        folder: is made if it does not exist.
        scene: the scene's file, or its dictionary for ``mi.load_dict``. Not needed if the fit got a file, or a renderer of
            ``Renderer.from_file`` or ``Renderer.from_dict``.
        parameters: values of ``$name`` in that file.

    Returns:
        The files that were written.

    Raises:
        OutputError: A folder or file cannot be written.
    """
    out = Path(folder)
    files.make_folder(out)
    result.write_json(out / RESULT)
    film = encode_film(result.pictures) if any(picture.frames for picture in result.pictures) else None
    write_report(result, out / REPORT, film=film)
    written = [out / RESULT, out / REPORT]
    if film is not None:
        with files.atomic(out / FILM) as temporary:
            temporary.write_bytes(film)
        written.append(out / FILM)
    return written + _scene_files(result, out, scene, parameters)


def _scene_files(
    result: FitResult,
    out: Path,
    scene: str | os.PathLike[str] | Mapping[str, Any] | None,
    parameters: Mapping[str, str] | None,
) -> list[Path]:
    """Write the fitted scene, as XML and as glTF."""
    fitted = result.scene
    if fitted is None:
        warn("the fitted scene was not written: the result, which was read from a file, does not hold it.")
        return []
    source = fitted.source if scene is None else scene if isinstance(scene, Mapping) else Path(scene)
    if source is None:
        warn("the fitted scene was not written: the fit was given a mi.Scene, whose file is not known; give it as scene=.")
        return []
    known = fitted.parameters if parameters is None and scene is None else parameters or {}
    try:
        written = write_fitted_scene(source, known, fitted.changes, out, names=fitted.names, copy_files=True)
    except ShadowmapError as error:
        warn(f"the fitted scene was not written: {error}")
        return []
    for note in written.notes:
        warn(f"{written.files[0]}: {note}")
    try:
        with second_thread():
            loaded = mi.load_file(str(written.files[0]), optimize=False)
        for note in write_glb(loaded, out / MODEL):
            console.note(f"{out / MODEL}: {note}.")
    except (ShadowmapError, RuntimeError) as error:
        console.note(f"{out / MODEL} was not written: {' '.join(str(error).split())}")
        return written.files
    return [*written.files, out / MODEL]

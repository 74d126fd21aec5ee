"""The command `shadowmap-dr fit`: poses, lights, materials and cameras of a scene from pictures."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from ..errors import ShadowmapError, quoted, shortened
from ..fitting.options import FitOptions
from ..fitting.task import FitTask, PictureFile, read_task
from ..fitting.vary import Vary
from ..io import console, files
from ..variants import DEFAULT_VARIANT, set_variant
from .options import Given, Variant, from_record
from .scene_argument import definitions, load, scene_file

# Most digits of the number of a sensor.
_DIGITS = 9


@from_record(first=("vary",))
def fit(
    scene: Annotated[
        str, typer.Argument(metavar="SCENE", help="Mitsuba XML file, the name of a scene of this package, or a fit.toml.")
    ],
    given: Given[FitOptions],
    target: Annotated[
        list[str] | None,
        typer.Option(metavar="[N=]FILE", help="Picture, of sensor N (counted from 0); repeatable."),
    ] = None,
    mask: Annotated[
        list[str] | None,
        typer.Option(metavar="[N=]FILE", help="Mask of the picture of sensor N: white pixels count; repeatable."),
    ] = None,
    define: Annotated[
        list[str] | None, typer.Option("-D", metavar="NAME=VALUE", help="Value of the parameter $NAME of the scene; repeatable.")
    ] = None,
    listing: Annotated[
        bool, typer.Option("--list", help="List all that can vary, or what --vary names, and how much it moves the image.")
    ] = False,
    out: Annotated[Path, typer.Option(metavar="PATH", help="Folder for the results.")] = Path("fit"),
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a fit that did not end.")] = False,
    variant: Variant = DEFAULT_VARIANT,
) -> None:
    """Find poses, lights, materials and cameras of a scene from pictures of it.

    Writes OUT/report.html, fit.json, fit.toml, film.webp, and the fitted scene (scene.xml, scene.glb).
    """
    task = _task(scene, given, target or [], mask or [], definitions(define or []))
    path = scene_file(task.scene)
    set_variant(variant)
    from ..fitting.scene_loading import load_scene

    loaded = load(path, dict(task.parameters), load_scene)
    if listing:
        from ..fitting.listing import listed

        entries = [one for one in task.options.vary if isinstance(one, Vary)]
        console.show(listed(loaded, entries, {picture.sensor for picture in task.pictures}))
        return
    from ..fitting.command import run_fit
    from ..fitting.table import directions, table
    from ..fitting.writing import REPORT, RESULT

    result = run_fit(task, loaded, path, out, resume=resume)
    console.show(table(result))
    for line in directions(result):
        typer.echo(line)
    for words in result.words:
        typer.echo(words)
    typer.echo(f"{'Found' if result.found else 'Not found'}, in {result.seconds:.0f} s.")
    console.result(out / REPORT, out / RESULT)


def _task(scene: str, given: Given[FitOptions], targets: list[str], masks: list[str], parameters: dict[str, str]) -> FitTask:
    """The task of a command line; options that are given come before those of a fit.toml."""
    masked = {}
    for entry in masks:
        sensor, file = _numbered("--mask", entry)
        if sensor in masked:
            raise ShadowmapError(f"--mask {shortened(entry)}: the picture of sensor {sensor} has a mask already.")
        masked[sensor] = file
    pictures = [PictureFile(file, sensor) for sensor, file in (_numbered("--target", entry) for entry in targets)]
    sensors = {picture.sensor for picture in pictures}
    for sensor in masked:
        if sensor not in sensors and targets:
            raise ShadowmapError(f"--mask {sensor}={shortened(masked[sensor])}: there is no --target of sensor {sensor}.")
    pictures = [replace(picture, mask=masked.get(picture.sensor)) for picture in pictures]
    if not scene.lower().endswith(".toml"):
        return FitTask(scene, parameters, pictures, given.make())
    files.check_readable(Path(scene))
    task = read_task(Path(scene))
    changes: dict[str, Any] = {**given.chosen}
    return FitTask(task.scene, {**task.parameters, **parameters}, pictures or task.pictures, replace(task.options, **changes))


def _numbered(option: str, entry: str) -> tuple[int, str]:
    """(sensor, file) of ``FILE`` or ``N=FILE``."""
    found = re.fullmatch(r"(?:(\d+)=)?(.+)", entry, re.DOTALL)
    if found is None:
        raise ShadowmapError(f"{option} {quoted(entry)}: write FILE or N=FILE, with the number of the sensor.")
    files.check_name(found[2])
    number = found[1] or "0"
    if len(number) > _DIGITS:
        raise ShadowmapError(f"{option} {quoted(entry)}: no scene has so many sensors; N is counted from 0.")
    return int(number), found[2]

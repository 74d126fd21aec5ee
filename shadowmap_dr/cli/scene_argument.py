"""Scenes as arguments of commands: names, files, and values of their parameters."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path

import mitsuba as mi

from ..errors import ShadowmapError, mitsuba_message, nearest, quoted, shortened
from ..importing.reader import SUFFIXES as IMPORTED
from ..io import assets, files
from ..io.pictures import SUFFIXES
from ..jit.threads import second_thread

# Suffixes of models; those of `IMPORTED` become scenes by `shadowmap-dr import`.
_MODELS = (*IMPORTED, ".serialized", ".fbx", ".blend", ".dae", ".usd", ".usdz", ".3ds")


def scene_file(name: str) -> Path:
    """Path of a scene by name or file. ShadowmapError, with what to do, for a folder, a mesh, a picture, and what is no XML."""
    files.check_name(name)
    given = Path(name)
    if name in assets.scene_names() or not os.path.exists(given):
        beside = [path.name for path in given.parent.glob("*.xml")] if os.path.isdir(given.parent) else []
        if name not in assets.scene_names() and beside and (near := nearest(given.name, beside)):
            raise ShadowmapError(f"no scene {name!r}: there is no such file. Did you mean {str(given.with_name(near))!r}?")
        return assets.scene(name)
    suffix = given.suffix.lower()
    if given.is_dir():
        scenes = sorted(path.name for path in given.glob("*.xml"))
        raise ShadowmapError(
            f"no scene {name!r}: it is a folder; give a file in it ({', '.join(scenes[:5]) or 'it has no .xml'})."
        )
    if suffix in _MODELS:
        made = given.with_suffix(".xml").name
        how = f"shadowmap-dr import {name} -o {made}" if suffix in IMPORTED else "convert it to .glb or .ply"
        raise ShadowmapError(f"{name} is a model, and no scene of Mitsuba's: make one of it first: {how}.")
    if suffix in SUFFIXES:
        raise ShadowmapError(f"{name} is a picture: give a Mitsuba scene (.xml), or one of {', '.join(assets.scene_names())}.")
    with given.open("rb") as file:
        if not file.read(1024).lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<"):
            raise ShadowmapError(f"{name} is no XML: give a Mitsuba scene (.xml), or one of {', '.join(assets.scene_names())}.")
    return given.resolve()


def definitions(entries: list[str]) -> dict[str, str]:
    values: dict[str, str] = {}
    for entry in entries:
        match = re.fullmatch(r"([A-Za-z_]\w*)=(.*)", entry)
        if match is None:
            raise ShadowmapError(f"-D {shortened(entry)}: write it as NAME=VALUE, for instance -D resolution=256.")
        name, value = match.groups()
        files.check_name(value)
        if name in values:
            raise ShadowmapError(f"-D {shortened(entry)}: {shortened(name)} has a value already, {quoted(values[name])}.")
        if value.strip().lower() in ("nan", "-nan", "inf", "-inf", "+inf", "infinity", "-infinity"):
            raise ShadowmapError(f"-D {shortened(entry)}: {value} is no finite number.")
        values[name] = value
    return values


def load(path: Path, values: dict[str, str], loader: Callable[[str, dict[str, str]], object] | None = None) -> mi.Scene:
    """Load a scene file. ``loader``: instead of ``mi.load_file``."""
    try:
        with second_thread():
            loaded = mi.load_file(str(path), **values) if loader is None else loader(str(path), values)
    except ShadowmapError:
        raise
    except (RuntimeError, UnicodeError) as error:
        raise ShadowmapError(f"cannot load {path}: {one_line(error)}") from error
    if not isinstance(loaded, mi.Scene):
        raise ShadowmapError(f"cannot load {path}: its root is a {type(loaded).__name__}, not a scene.")
    if not loaded.sensors():
        raise ShadowmapError(f"cannot render {path}: the scene has no sensor.")
    return loaded


def one_line(error: BaseException) -> str:
    """Message of a Mitsuba exception, without line breaks and positions in Mitsuba's source."""
    text = str(error)
    if "Traceback (most recent call last)" in text:  # raised by a Python plug-in: the message is the last line
        return re.sub(r"^[\w.]*(?:Error|Exception): ", "", text.strip().splitlines()[-1])
    return mitsuba_message(error)

"""Commands of a few steps on small images, from the start, and resumed in folders whose files were edited."""

from __future__ import annotations

import functools
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from shadowmap_dr.experiments.art import run as art_run
from shadowmap_dr.inverse.runs import loop
from shadowmap_dr.io.files import read_arrays

from .commands import run_command
from .options import parameters, random_option, write_files
from .outcome import check
from .values import chance, changed_arrays, changed_json, mutated, npz, pick

#: Command lines -> options that change neither their time nor their memory by much.
COMMANDS = {
    "art --target heart --resolution 32 --map-resolution 32 --iterations 2 --animate none --mesh mesh.ply": (
        *("--smoothness", "--receiver", "--camera", "--fill-holes", "--printable", "--text", "--target", "--mesh", "--resume"),
    ),
    "face --head 3 --shadows 1 --iterations 2 --height 24 --map-resolution 24": (
        *("--prior", "--filter-size", "--image", "--model", "--resume", "--translate"),
    ),
    "lights --object mesh.ply --runs 2 --iterations 2 --resolution 24 --map-resolution 24 --filter-size 3": (
        *("--filter", "--cone", "--strategy", "--memory", "--resume"),
    ),
    "pose --object mesh.ply --method shadows --reference own --resolution 16 --runs 2 --iterations 2": (
        *("--seed", "--normals", "--shadow-only", "--resume", "--object"),
    ),
    "soft --scene disk --samples 2/2 --resolution 16 --map-resolution 32 --spp 1 --reference-spp 16 --no-times": (
        "--resume",
        "--times",
    ),
    "gradients jacobian --motion x --map-resolution 32 --filter-size 3 --faces 99 --mitsuba-passes 0 --resolution 32 --spp 4": (),
    "gradients convergence --occluder plane --camera orthographic --map-resolution 32 --filter-size 3 --displacement 0.1 "
    "--resolution 32 --iterations 2": ("--camera", "--occluder"),
    "info": (),
}
# Commands that resume, with the record that the last run leaves; a folder's name is that of the command.
_RESUMED = [line for line in COMMANDS if line != "info"]


def run(rng: np.random.Generator, folder: Path) -> str:
    """Run a command."""
    write_files(folder)
    return _resumed(rng) if chance(rng, 0.7) else _short(rng)


def _short(rng: np.random.Generator) -> str:
    line = pick(rng, tuple(COMMANDS))
    words = line.split()
    own = parameters()[" ".join(words[:2])] if words[0] == "gradients" else parameters()[words[0]]
    for parameter in own:
        if parameter.opts[0] in COMMANDS[line] and chance(rng, 0.2):
            words += random_option(rng, parameter)
    run_command(words)
    _check_records(Path())
    return " ".join(words)


def _check_records(folder: Path) -> None:
    """Check that all records are JSON."""
    for path in folder.rglob("*.json"):
        check(isinstance(json.loads(path.read_text()), (dict, list)), f"{path} is no record")


@functools.cache
def _finished(line: str) -> tuple[Path, Path]:
    """A copy of a folder in which the command has run, and the folder. Checkpoints of its last steps are ``*.npz.kept``."""
    copy, folder = Path(tempfile.mkdtemp()), Path(tempfile.mkdtemp())
    write_files(folder)
    here = os.getcwd()
    os.chdir(folder)
    try:
        with _keeping_checkpoints():
            run_command(line.split())
    finally:
        os.chdir(here)
    shutil.copytree(folder, copy, dirs_exist_ok=True)
    return copy, folder


@contextmanager
def _keeping_checkpoints() -> Iterator[None]:
    with ExitStack() as stack:
        for module in (loop, art_run):
            save: Any = module._save

            def keep(path: Path, *values: Any, save: Any = save) -> None:
                save(path, *values)
                shutil.copy(path, path.with_name(f"{path.name}.kept"))

            stack.enter_context(mock.patch.object(module, "_save", keep))
        yield


def _resumed(rng: np.random.Generator) -> str:
    line = pick(rng, tuple(_RESUMED))
    finished, folder = _finished(line)
    # Records may name files by their places.
    shutil.rmtree(folder)
    shutil.copytree(finished, folder)
    os.chdir(folder)
    paths = sorted(
        path for path in folder.rglob("*") if path.suffix in (".json", ".exr", ".npz", ".md", ".ply") and path.name != "mesh.ply"
    )
    for path in folder.rglob("*.kept"):
        killed = path.with_suffix("")
        path.replace(killed)
        if chance(rng, 0.5):
            killed.unlink()
    killed_ones = sorted(folder.rglob("*checkpoint*.npz")) + sorted(folder.rglob("checkpoints/*.npz"))
    if killed_ones:  # a killed run has no record
        for path in folder.rglob("*.json"):
            path.unlink()
        paths = killed_ones
    for _ in range(int(rng.integers(1, 3))):
        _edit(rng, pick(rng, [path for path in paths if path.exists()] or [folder / "mesh.ply"]))
    run_command([*line.split(), "--resume"])
    _check_records(folder / "gradients" if line.startswith("gradients") else folder / line.split()[0])
    return f"{line.split()[0]}: resumed"


def _edit(rng: np.random.Generator, path: Path) -> None:
    """Edit a file, or remove it."""
    if chance(rng, 0.1) or not path.exists():
        path.unlink(missing_ok=True)
    elif path.suffix == ".json" and chance(rng, 0.8):
        try:
            value = json.loads(path.read_text())
        except ValueError:
            return
        for name in ("checks", "check"):
            if isinstance(value, dict) and chance(rng, 0.6):
                value.pop(name, None)
        path.write_text(json.dumps(changed_json(rng, value)))
    elif path.suffix == ".npz" and chance(rng, 0.8):
        path.write_bytes(npz(changed_arrays(rng, read_arrays(path))))
    else:
        path.write_bytes(mutated(rng, path.read_bytes()))

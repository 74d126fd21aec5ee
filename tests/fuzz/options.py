"""Command lines with random values of their options: refused, or accepted. Nothing is computed."""

from __future__ import annotations

import functools
import importlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import typer
from PIL import Image, ImageDraw

from shadowmap_dr.cli import main

from . import mesh_files
from .commands import run_command
from .values import INTEGERS, NUMBERS, chance, pick

_ARGUMENTS = {"model": ("sphere", "mesh.ply", "none.ply", "bunny", ""), "render": ("scene.xml", "gallery", "none", "folder"),
              "face convert": ("folder out.npz", "mesh.ply out.npz", "none out.npz", "folder out.txt")}  # fmt: skip


class _Accepted(SystemExit):
    """The command has accepted its options."""


def run(rng: np.random.Generator, folder: Path) -> str:
    """Call a command."""
    write_files(folder)
    name = pick(rng, tuple(parameters()))
    words = _words(rng, name)
    with _nothing_runs():
        said = run_command(words)
    return f"accepted: {' '.join(words)}" if not said else said[:200]


@functools.cache
def parameters() -> dict[str, list[Any]]:
    """Options of all commands, by the words that call them."""
    program: Any = typer.main.get_command(main.app)
    found: dict[str, list[Any]] = {}
    for name in main.COMMANDS:
        command = program.get_command(None, name)
        if command.callback is not None:
            found[name] = [one for one in command.params if one.opts[0].startswith("-")]
        for inner, one in getattr(command, "commands", {}).items():
            found[f"{name} {inner}"] = [own for own in one.params if own.opts[0].startswith("-")]
    return found


def _words(rng: np.random.Generator, name: str) -> list[str]:
    words = name.split()
    if name in _ARGUMENTS and chance(rng, 0.95):
        words += pick(rng, _ARGUMENTS[name]).split()
    if name == "art" and chance(rng, 0.8):
        words += ["--target", pick(rng, ("heart", "picture.png", "none.png"))]
    if name == "render" and chance(rng, 0.9):
        words += ["-o", "image.exr"]
    for _ in range(int(pick(rng, (0, 1, 1, 1, 2, 3)))):
        words += random_option(rng, pick(rng, parameters()[name])) if parameters()[name] else []
    if chance(rng, 0.05):
        words.append(pick(rng, ("--none", "-x", "--", "", "\udcff", "x" * 500, "--help", "\x00", "--out")))
    return [word.replace("\x00", "0") for word in words]


def random_option(rng: np.random.Generator, parameter: Any) -> list[str]:
    """An option with a value by its type, often at the ends of its range."""
    name = pick(rng, (*parameter.opts, *parameter.secondary_opts))
    if getattr(parameter, "is_flag", False):
        return [name]
    known = (parameter.metavar or "").split("|")
    kind = str(getattr(parameter, "type_descriptor", ""))
    if "int" in kind and chance(rng, 0.9):
        value = str(pick(rng, INTEGERS))
    elif "float" in kind and chance(rng, 0.9):
        value = str(pick(rng, NUMBERS))
    elif len(known) > 1 and chance(rng, 0.7):
        value = pick(rng, known)
    elif "Path" in kind and chance(rng, 0.8):
        value = pick(
            rng, ("new", "folder", "mesh.ply", "none/deep/new", "picture.png", "", ".", "/dev/null", "/proc/none", "é", "x" * 300)
        )
    else:
        value = pick(
            rng,
            (
                "",
                "x",
                "0",
                "-1",
                "1e9",
                "nan",
                "3/0",
                "1/2",
                "99999x2",
                "2x3",
                "heart",
                "mesh.ply",
                "a=b",
                "é\udcff",
                "\n",
                "llvm_ad_rgb",
                "scalar_rgb",
                "cuda_ad_rgb",
                "processes:0",
                "tcp://127.0.0.1:1",
                " ",
            ),
        )
    return [name, value]


@contextmanager
def _nothing_runs() -> Iterator[None]:
    """Commands end where they have accepted their options and begin to compute."""
    with ExitStack() as stack:
        for place in main.COMMANDS.values():
            module = importlib.import_module(f"shadowmap_dr.cli.{place.module}")
            if hasattr(module, "set_variant"):
                stack.enter_context(mock.patch.object(module, "set_variant", side_effect=_accepted))
        yield


def _accepted(*_: object) -> None:
    raise _Accepted(0)


def write_files(folder: Path) -> None:
    """Files that options name."""
    (folder / "folder").mkdir()
    (folder / "mesh.ply").write_bytes(mesh_files.files()["ply"][1])
    (folder / "scene.xml").write_text('<scene version="3.0.0"></scene>')
    picture = Image.new("L", (40, 40), 255)
    ImageDraw.Draw(picture).ellipse((10, 10, 30, 30), 0)
    picture.save(folder / "picture.png")

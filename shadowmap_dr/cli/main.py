"""The command line program `shadowmap-dr`."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import sys
from dataclasses import dataclass
from typing import Any

import typer
import typer.core
from rich.console import Console

from ..errors import ShadowmapError, is_interrupt


@dataclass(frozen=True)
class Command:
    """Definition of a command: a function, or a group of commands, of a module of this package; and its line in the help."""

    module: str
    function: str
    help: str


#: By name, in the order in which help lists them.
COMMANDS = {
    "soft": Command(
        "soft",
        "soft",
        "Compare images under area lights and skies with path-traced ones: errors, how they fall with samples, and times.",
    ),
    "lights": Command("lights", "lights", "Find the directions of lights by comparing images, many runs at once."),
    "lights-times": Command(
        "lights",
        "lights_times",
        "Measure how long a step of light estimation takes for a run, in batches and alone, and what more workers bring.",
    ),
    "art": Command("art", "art", "Deform an object until its shadow is a given picture, or its two shadows two pictures."),
    "model": Command("model", "model", "Deform a mesh by painting on its shadow."),
    "info": Command("info", "info", "Show versions, the LLVM library, variants, threads and the GPU."),
    "render": Command("render", "render", "Render a Mitsuba scene."),
    "pose": Command("pose", "pose", "Find an object's pose from an image of it and its shadow, with three methods side by side."),
    "maps": Command("maps", "maps", "Compare all shadow maps on scenes that are hard for them, against path tracing."),
    "bench": Command(
        "bench", "bench", "Measure steps, rasterization, how costs grow, and where the time goes, beside Mitsuba and Embree."
    ),
    "gradients": Command("gradients", "app", "Measure the derivatives of shadows, and what can be found with them."),
    "face": Command("face", "app", "Find a head from its profile shadow."),
}


class _Commands(typer.core.TyperGroup):
    """The commands, each imported when it is called: experiments and all that they use take a second."""

    def list_commands(self, ctx: Any) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name not in COMMANDS:
            return None
        place = COMMANDS[cmd_name]
        found = getattr(importlib.import_module(f"{__package__}.{place.module}"), place.function)
        # A program of the same kind with this command alone: what help looks like is a setting of the whole.
        program = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
        program.callback()(_program)
        if isinstance(found, typer.Typer):
            program.add_typer(found, name=cmd_name)
        else:
            program.command(cmd_name)(found)
        return typer.main.get_command(program).commands[cmd_name]

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Names and first sentences, cut off to a line each, without an import of any command."""
        room = formatter.width - 6 - max(map(len, COMMANDS))
        with formatter.section("Commands"):
            formatter.write_dl([(name, _shortened(place.help, room)) for name, place in COMMANDS.items()])


def _shortened(words: str, room: int) -> str:
    """The first sentence, or as many of its words as there is room for."""
    sentence = words.partition(". ")[0].removesuffix(".") + "."
    if len(sentence) <= room:
        return sentence
    kept: list[str] = []
    for word in sentence.split():
        if len(" ".join([*kept, word])) > room - 3:
            break
        kept.append(word)
    return " ".join(kept) + "..."


app = typer.Typer(
    cls=_Commands,
    name="shadowmap-dr",
    help="Differentiable shadow mapping for Mitsuba 3.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


@app.callback()
def _program() -> None:
    """Differentiable shadow mapping for Mitsuba 3."""


def main() -> None:
    """Entry point: every expected failure is one line on the standard error stream and a non-zero exit status."""
    try:
        status = typer.main.get_command(app)(standalone_mode=False)
        sys.stdout.flush()  # here, where a failure is still one line
    except ShadowmapError as error:
        _fail(str(error), 1)
    except KeyboardInterrupt:
        _fail("interrupted", 130)
    except BrokenPipeError:  # the reader of our output has gone
        _drop_output()
        sys.exit(1)
    except OSError as error:  # for instance a full disk behind the standard output
        _drop_output()
        _fail(str(error), 1)
    except Exception as error:
        if hasattr(error, "format_message"):  # wrong usage, reported by the option parser
            message = error.format_message()
            _fail(message, 2) if message else sys.exit(2)  # without any argument the help has been shown
        if type(error).__name__ == "Abort" or is_interrupt(error):
            _fail("interrupted", 130)
        raise
    sys.exit(status if isinstance(status, int) else 0)


def _drop_output() -> None:
    """Send output that is still buffered and cannot be written nowhere: the interpreter would try again at exit, and complain."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _fail(message: str, status: int) -> None:
    Console(stderr=True, soft_wrap=True, highlight=False, markup=False).print(f"error: {' '.join(message.split())}")
    sys.exit(status)

"""The command line program `shadowmap-dr`."""

from __future__ import annotations

import importlib
import os
import sys
import warnings
from dataclasses import dataclass
from typing import Any, TextIO

import typer
import typer.core

from ..errors import ShadowmapError, is_interrupt


@dataclass(frozen=True)
class Command:
    """Definition of a command: module of this package, its function or group of commands, and the help text."""

    module: str
    function: str
    help: str


#: Commands by name, in the order of the help.
COMMANDS = {
    "soft": Command(
        "soft",
        "soft",
        "Compare images under area lights and skies with path-traced ones: errors, their convergence with samples, and times.",
    ),
    "lights": Command("lights", "lights", "Find the directions of lights by comparing images, many runs at once."),
    "lights-times": Command(
        "lights",
        "lights_times",
        "Measure the time of a step of light estimation for a run, in batches and alone, and the gain by more workers.",
    ),
    "art": Command("art", "art", "Deform an object until its shadow is a given picture, or its two shadows two pictures."),
    "model": Command("model", "model", "Deform a mesh by painting on its shadow."),
    "info": Command("info", "info", "Show versions, the LLVM library, variants, threads and the GPU."),
    "render": Command("render", "render", "Render a Mitsuba scene."),
    "pose": Command(
        "pose", "pose", "Find an object's pose from an image of the object and its shadow, with three methods side by side."
    ),
    "maps": Command("maps", "maps", "Compare all shadow maps on scenes that are hard for them, against path tracing."),
    "bench": Command(
        "bench", "bench", "Measure times of steps and rasterization, growth of costs, and profiles, beside Mitsuba and Embree."
    ),
    "gradients": Command("gradients", "app", "Measure the derivatives of shadows, and test them in optimisations."),
    "face": Command("face", "app", "Find a head from its profile shadow."),
}


class _Commands(typer.core.TyperGroup):
    """Group of commands that are imported when they are called: importing all experiments takes a second."""

    def list_commands(self, ctx: Any) -> list[str]:  # Any: Typer's or Click's Context, by the version of Typer
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # Any: as above, and Command
        if cmd_name not in COMMANDS:
            return None
        place = COMMANDS[cmd_name]
        found = getattr(importlib.import_module(f"{__package__}.{place.module}"), place.function)
        # A program with this command alone and the same settings: the style of help is a setting of the program.
        program = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
        program.callback()(_program)
        if isinstance(found, typer.Typer):
            program.add_typer(found, name=cmd_name)
        else:
            program.command(cmd_name)(found)
        return typer.main.get_group(program).commands[cmd_name]

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # Any: as above, and HelpFormatter
        """Write names and shortened first sentences, one line each, without importing the commands."""
        room = formatter.width - 6 - max(map(len, COMMANDS))
        with formatter.section("Commands"):
            formatter.write_dl([(name, _shortened(place.help, room)) for name, place in COMMANDS.items()])


def _shortened(words: str, room: int) -> str:
    """The first sentence, cut to ``room`` characters at a word."""
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
    """Entry point. Every expected failure gives one line on standard error and a non-zero exit status."""
    warnings.showwarning = _show_warning
    try:
        status = typer.main.get_command(app)(standalone_mode=False)
        sys.stdout.flush()  # here, where a failure still gives one line
    except ShadowmapError as error:
        _fail(str(error), 1)
    except KeyboardInterrupt:
        _fail("interrupted", 130)
    except BrokenPipeError:  # the reader of standard output has closed it
        _drop_output()
        sys.exit(1)
    except UnicodeError as error:  # a name, or an argument, of bytes that are no text
        _fail(f"a name is not UTF-8 ({error}): choose another, or rename the file", 1)
    except OSError as error:  # for instance a full disk behind the standard output
        _drop_output()
        _fail(str(error), 1)
    except Exception as error:
        if hasattr(error, "format_message"):  # wrong usage, found by the option parser
            message = error.format_message()
            _fail(message, 2) if message else sys.exit(2)  # without arguments the help has been shown
        if type(error).__name__ == "Abort" or is_interrupt(error):
            _fail("interrupted", 130)
        raise
    sys.exit(status if isinstance(status, int) else 0)


def _drop_output() -> None:
    """Discard buffered output that cannot be written: the interpreter would try again at exit, and print an error."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _fail(message: str, status: int) -> None:
    _note(f"error: {message}")
    sys.exit(status)


def _note(message: object) -> None:
    """A line on standard error; names of files may hold bytes that are no text."""
    from rich.console import Console

    line = " ".join(str(message).split()).encode("utf-8", "backslashreplace").decode("utf-8")
    Console(stderr=True, soft_wrap=True, highlight=False, markup=False).print(line)


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """A warning as a line, without the line of code that gave it."""
    _note(f"{'warning' if issubclass(category, UserWarning) else category.__name__}: {message}")

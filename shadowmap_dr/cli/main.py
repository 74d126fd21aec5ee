"""The command line program `shadowmap-dr`."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import platform
import sys
import time
import traceback
import warnings
from dataclasses import dataclass
from typing import Any, TextIO

import typer
import typer.core

from .. import __version__
from ..errors import ShadowmapError, Verbosity, concise, is_interrupt, set_verbosity, verbosity
from .usage import explained


@dataclass(frozen=True)
class Command:
    """Definition of a command: module of this package, its function or group of commands, and the help text."""

    module: str
    function: str
    help: str


#: Commands by name, in the order of the help: pictures first, then applications, then measurements.
COMMANDS = {
    "render": Command("render", "render", "Render a Mitsuba scene."),
    "import": Command(
        "import_model", "import_command", "Make a Mitsuba scene of a model: meshes, materials, textures, cameras and lights."
    ),
    "fit": Command("fit", "fit", "Find poses, lights, materials and cameras of a scene from pictures of it."),
    "pose": Command(
        "pose", "pose", "Find an object's pose from an image of the object and its shadow, with three methods side by side."
    ),
    "lights": Command("lights", "lights", "Find the directions of lights by comparing images, many runs at once."),
    "art": Command("art", "art", "Deform an object until its shadow is a given picture, or its two shadows two pictures."),
    "face": Command("face", "app", "Find a head from its profile shadow."),
    "model": Command("model", "model", "Deform a mesh by painting on its shadow."),
    "soft": Command(
        "soft",
        "soft",
        "Compare images under area lights and skies with path-traced ones: errors, their convergence with samples, and times.",
    ),
    "maps": Command("maps", "maps", "Compare all shadow maps on scenes that are hard for them, against path tracing."),
    "gradients": Command("gradients", "app", "Measure the derivatives of shadows, and test them in optimisations."),
    "bench": Command(
        "bench", "bench", "Measure times of steps and rasterization, growth of costs, and profiles, beside Mitsuba and Embree."
    ),
    "lights-times": Command(
        "lights",
        "lights_times",
        "Measure the time of a step of light estimation for a run, in batches and alone, and the gain by more workers.",
    ),
    "info": Command("info", "info", "Show versions, the LLVM library, variants, threads and the GPU."),
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
        group = typer.main.get_group(program)
        command = group.commands[cmd_name]
        shared = [option for option in group.params if option.name in _SHARED]
        for one in (command, *getattr(command, "commands", {}).values()):
            one.params.extend(shared)
        return command

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
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"shadowmap-dr {__version__}")
        raise typer.Exit()


def _quiet(wanted: bool) -> None:
    if wanted:
        set_verbosity(Verbosity.QUIET)


def _verbose(wanted: bool) -> None:
    if wanted and verbosity() < Verbosity.VERBOSE:
        set_verbosity(Verbosity.VERBOSE)
        _note(_versions())


#: Options of all commands, which may also stand before the command.
_SHARED = ("quiet", "verbose")


@app.callback()
def _program(
    version: bool = typer.Option(False, "--version", callback=_show_version, is_eager=True, help="Show the version and exit."),
    quiet: bool = typer.Option(
        False, "--quiet", "-q", callback=_quiet, expose_value=False, help="Print errors and results only."
    ),
    verbose: bool = typer.Option(
        False,
        "--verbose",
        "-v",
        callback=_verbose,
        expose_value=False,
        help="Print versions, times, and origins of warnings and errors.",
    ),
) -> None:
    """Differentiable shadow mapping for Mitsuba 3."""


def _versions() -> str:
    """Versions that results depend on, in one line."""
    installed = [f"{name} {importlib.metadata.version(name)}" for name in ("mitsuba", "drjit", "numpy")]
    return ", ".join([f"shadowmap-dr {__version__}", *installed, f"Python {platform.python_version()}"])


def main() -> None:
    """Entry point. Every expected failure ends in a line ``error: ...`` on standard error and a non-zero exit status.

    Wrong usage has the usage before that line and the way to the help behind it; other failures have this line alone.
    """
    warnings.showwarning = _show_warning
    set_verbosity(Verbosity.USUAL)
    _show_logs_of_mitsuba()
    began = time.perf_counter()
    try:
        status = typer.main.get_command(app)(standalone_mode=False, prog_name="shadowmap-dr")
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
            if type(error).__name__ == "NoArgsIsHelpError":
                typer.echo(message, err=True)  # the help
                sys.exit(2)
            for line in explained(error, message) if message else ():  # without arguments the help has been shown
                _note(line)
            sys.exit(2)
        if type(error).__name__ == "Abort" or is_interrupt(error):
            _fail("interrupted", 130)
        raise
    if verbosity() is Verbosity.VERBOSE:
        _note(f"{time.perf_counter() - began:.1f} seconds")
    sys.exit(status if isinstance(status, int) else 0)


def _drop_output() -> None:
    """Discard buffered output that cannot be written: the interpreter would try again at exit, and print an error."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _fail(message: str, status: int) -> None:
    if verbosity() is Verbosity.VERBOSE and sys.exc_info()[0] is not None:
        traceback.print_exc()
    _note(concise(f"error: {message}"))
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
    """A warning as a line, without the line of code that gave it; with ``--verbose`` with its kind and its origin."""
    if verbosity() is Verbosity.QUIET:
        return
    origin = f" ({category.__name__}, {filename}:{lineno})" if verbosity() is Verbosity.VERBOSE else ""
    _note(f"warning: {message}{origin}")


def _show_logs_of_mitsuba() -> None:
    """Replace Mitsuba's log, which goes to standard output with dates and colours, by lines on standard error."""
    import mitsuba as mi

    class Lines(mi.Appender):
        """Writer of log entries."""

        def append(self, level: mi.LogLevel, text: str) -> None:
            if verbosity() is not Verbosity.QUIET:
                _note(f"warning: Mitsuba: {text}" if level >= mi.LogLevel.Warn else f"Mitsuba: {text}")

        def log_progress(self, *_: object) -> None:
            pass

    logger = mi.logger()
    logger.clear_appenders()
    logger.add_appender(Lines())
    formatter = logger.formatter()
    for kind in ("class", "date", "thread", "log_level"):
        getattr(formatter, f"set_has_{kind}")(False)

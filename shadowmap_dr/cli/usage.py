"""Wrong usage of the command line: the usage, the error with the nearest known word, and the way to the help."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from ..errors import concise, did_you_mean


def explained(error: Any, message: str) -> list[str]:  # Any: Typer's or Click's UsageError, by the version of Typer
    """Lines about an error of the option parser, whose message is ``message``. The second of them begins with ``error:``."""
    context = getattr(error, "ctx", None)
    if context is None:
        return [concise(f"error: {message}")]
    name = getattr(error, "option_name", None)
    if name is not None and message.startswith("No such option"):
        message = f"No such option {name!r}." + did_you_mean(name, _options(context))
    command = re.fullmatch(r"No such command '(.*)'\.", message)
    if command:
        message += did_you_mean(command[1], context.command.list_commands(context))
    usage = " ".join(context.get_usage().split())
    return [usage, concise(f"error: {message}"), f"Try '{context.command_path} --help' for help."]


def _options(context: Any) -> Iterator[str]:  # Any: as above, a Context
    """Names of all options of a command."""
    for parameter in context.command.get_params(context):
        yield from (name for name in (*parameter.opts, *parameter.secondary_opts) if name.startswith("--"))

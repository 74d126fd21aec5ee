"""Reference of the command line, from the program itself."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import typer
from tables import code, table

from shadowmap_dr.cli.main import app

_DEFAULT = re.compile(r"\s*\[default: (.*)\]\.?$", re.DOTALL)


def commands() -> str:
    """Sections (Markdown) of all commands: synopsis, description, arguments and options."""
    return "\n\n".join(section for section in _sections(typer.main.get_command(app), app.info.name))


def _sections(command: Any, name: str) -> Iterator[str]:  # Any: a command of Click or of Typer, by Typer's version
    names = command.list_commands(None) if hasattr(command, "list_commands") else []
    for each in names:
        yield from _sections(command.get_command(None, each), f"{name} {each}")
    if not names:
        yield _section(command, name)


def _section(command: Any, name: str) -> str:  # Any: as above
    shown = [parameter for parameter in command.params if not getattr(parameter, "hidden", False) and parameter.name != "help"]
    arguments = [parameter for parameter in shown if parameter.param_type_name == "argument"]
    options = [parameter for parameter in shown if parameter.param_type_name == "option"]
    places = " ".join(_placeholder(argument) for argument in arguments)
    synopsis = " ".join(filter(None, [name, places, "[OPTIONS]" if options else ""]))
    parts = [f"## {name.partition(' ')[2]}", f"```text\n{synopsis}\n```", _text(command.help or "")]
    if arguments:
        parts.append(table(("Argument", "Meaning"), [(code(_placeholder(each)), _text(each.help or "")) for each in arguments]))
    if options:
        parts.append(table(("Option", "Value", "Default", "Meaning"), [_option(each) for each in options]))
    return "\n\n".join(part for part in parts if part)


def _placeholder(argument: Any) -> str:  # Any: as above
    word = argument.metavar or argument.name.upper()
    return word if argument.required or word.startswith("[") else f"[{word}]"


def _option(option: Any) -> tuple[str, str, str, str]:  # Any: as above
    names = " ".join(code(name) for name in (*option.opts, *option.secondary_opts))
    text, default = _DEFAULT.sub("", option.help or ""), _DEFAULT.search(option.help or "")
    shown = default[1] if default else "" if option.default in (None, False) or callable(option.default) else str(option.default)
    kind = "switch" if option.is_flag else ", ".join(code(word) for word in (option.metavar or _type(option)).split("|"))
    return (
        names,
        kind + ("; repeatable" if option.multiple else ""),
        code(shown) if shown else "required" if option.required else "",
        _text(text),
    )


def _type(option: Any) -> str:  # Any: as above
    """The word for an option's type, with its range."""
    # Typer's own options know a Python type, those of Click a named one.
    word = option.bare_type() if hasattr(option, "bare_type") else option.type.name
    word = re.sub(r"^list\[(.*)\]$", r"\1", word)  # of options that can be repeated
    least, most = (getattr(option, name, None) for name in ("min", "max"))
    limits = [f"{least} or more"] if most is None else [f"{least} to {most}"]
    return " ".join([word.lower(), *(limits if least is not None else [])])


def _text(text: str) -> str:
    """A help text as a paragraph, with names of options as code."""
    paragraph = re.sub(r"\s+", " ", text.replace("\b", "")).strip()
    return re.sub(r"(?<![`\w-])--[a-z][a-z-]*", lambda name: code(name[0]), paragraph)

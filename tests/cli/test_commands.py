"""The list of commands, which help shows without an import of any, says what the commands say themselves."""

from __future__ import annotations

import importlib
import inspect

import pytest
import typer

from shadowmap_dr.cli.main import COMMANDS


@pytest.mark.parametrize("name", COMMANDS)
def test_help_is_that_of_the_command(name: str) -> None:
    place = COMMANDS[name]
    found = getattr(importlib.import_module(f"shadowmap_dr.cli.{place.module}"), place.function)
    words = found.info.help if isinstance(found, typer.Typer) else inspect.getdoc(found)
    assert place.help == " ".join(words.split("\n\n")[0].split())

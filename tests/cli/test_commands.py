"""The list of commands, which help shows without an import of any, says what the commands say themselves."""

from __future__ import annotations

import importlib
import inspect
import subprocess
import sys

import pytest
import typer

from shadowmap_dr.cli.main import COMMANDS


@pytest.mark.parametrize("name", COMMANDS)
def test_help_is_that_of_the_command(name: str) -> None:
    place = COMMANDS[name]
    found = getattr(importlib.import_module(f"shadowmap_dr.cli.{place.module}"), place.function)
    words = found.info.help if isinstance(found, typer.Typer) else inspect.getdoc(found)
    assert place.help == " ".join(words.split("\n\n")[0].split())


def test_help_imports_nothing_that_renders() -> None:
    """``shadowmap-dr --help`` takes hardly longer than ``import mitsuba``."""
    code = (
        "import sys; sys.argv = ['shadowmap-dr', '--help']\nfrom shadowmap_dr.cli.main import main\n"
        "try:\n    main()\nfinally:\n    print(*sorted(sys.modules), file=sys.stderr)"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    loaded = set(shown.stderr.split())
    assert shown.returncode == 0 and "pose" in shown.stdout and "shadowmap_dr.cli.main" in loaded
    assert not loaded & {"numpy", "rich.console", "shadowmap_dr.rendering", "shadowmap_dr.shadow", "shadowmap_dr.experiments"}

"""Commands in the README, the pages and the scripts are understood by the real parsers, with all options. Cheap ones are run."""

from __future__ import annotations

import argparse
import ast
import importlib.util
import itertools
import re
import runpy
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from shadowmap_dr.cli.main import app

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"

if not DOCS.is_dir():
    pytest.skip("no documentation beside the tests", allow_module_level=True)

PROGRAM = "shadowmap-dr"
FENCE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
#: Words that stand for a value; all others in capitals are names of files.
VALUES = {
    **{"N": "8", "X": "0.1", "WxH": "8x8", "PIXELS": "1", "STEPS": "10", "LETTERS": "A", "NAME": "spot", "NAME=VALUE": "a=1"},
    **{"COMMAND": "info", "SECTION": "steps", "MESH": "spot", "processes:N": "processes:2", "tcp://...": "tcp://host:8786"},
}
#: Commands that are not the project's.
FOREIGN = {"python my_sweep.py": "a script of the reader's", "python -m venv venv": "Python's own"}


def sources() -> Iterator[tuple[str, str]]:
    """Names and texts: pages, and the first comments of scripts."""
    for path in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))):
        yield path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8")
    for path in sorted((DOCS / "examples").glob("*.py")):
        yield path.relative_to(ROOT).as_posix(), ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""


def blocks(text: str) -> Iterator[str]:
    """Indented lines, with those that go on in the next line."""
    lines = [line for line in text.splitlines() if line.startswith("    ")]
    joined: list[str] = []
    for line in (re.sub(r"\s#\s.*", "", line).rstrip() for line in lines):
        if joined and (joined[-1].endswith("\\") or line.strip().startswith("[-")):
            joined[-1] = joined[-1].removesuffix("\\") + " " + line.strip()
        else:
            joined.append(line.strip())
    yield from joined


def commands(text: str) -> Iterator[str]:
    """Commands in blocks and in the text of a page."""
    text = FENCE.sub("", text)
    spans = (" ".join(match[1].split()) for match in re.finditer(r"(?<!`)`([^`]+)`(?!`)", text))
    for line in itertools.chain(blocks(text), spans):
        for part in line.split(" && "):
            if re.match(rf"({PROGRAM}|python (-m )?[\w./]+|pip install) ?", part):
                yield part.strip()


def pages_by_command() -> dict[str, str]:
    found: dict[str, str] = {}
    for page, text in sources():
        for command in commands(text):
            found.setdefault(command, page)
    return found


FOUND = pages_by_command()


def spelled(command: str, file: Path) -> Iterator[list[str]]:
    """Words of a command, for each choice that it names.

    What is in brackets may be left out, and ``a | b`` in brackets is a choice; each is tried alone. ``...`` repeats what is
    before it, or stands for the options of the command above.
    """
    groups, nested = re.findall(_BRACKETS, command), re.sub(_BRACKETS, "", command)
    groups += re.findall(_BRACKETS, nested)  # around those
    required = shlex.split(re.sub(_BRACKETS, "", nested))
    for part in ["", *(choice for group in groups for choice in group.split(" | "))]:
        words = required + shlex.split(part)
        # After an option it is a value.
        words = [
            VALUES["NAME"] if word == "..." and before.startswith("-") else word
            for before, word in itertools.pairwise(["", *words])
        ]
        choices = [_choices(word, file) for word in words if word != "..."]
        for k, own in enumerate(choices):
            for word in own if k == 0 or len(own) > 1 else ():
                yield [word if j == k else other[0] for j, other in enumerate(choices)]


_BRACKETS = re.compile(r"(?<![\w'.])\[([^\[\]]*)\]")


def _choices(word: str, file: Path) -> list[str]:
    parts = [part for part in word.split("|") if part != "..."] if not word.startswith("--") else [word]
    return [VALUES.get(part, str(file) if re.fullmatch(r"[A-Z]{2,}(\.\w+)?", part) else part) for part in parts]


def understood(command: Any, name: str, words: list[str]) -> None:  # Any: a command of Click or of Typer, by Typer's version
    """Parse words with the command's own parser. Raises what it raises."""
    if words and hasattr(command, "list_commands") and words[0] in command.list_commands(None):
        if words[1:]:
            understood(command.get_command(None, words[0]), words[0], words[1:])
        return  # the name of a command alone is none to be typed
    try:
        context = command.make_context(name, list(words))
        if hasattr(command, "list_commands") and not words[0].startswith("-"):
            command.resolve_command(context, words)
    except typer.Exit:  # --help
        pass


class Parsed(Exception):
    """Raised where a script has read its command line."""


@pytest.fixture
def only_parsed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scripts end once they have read their command line."""
    real = argparse.ArgumentParser.parse_args

    def parse(self: argparse.ArgumentParser, *arguments: Any, **options: Any) -> None:
        real(self, *arguments, **options)
        raise Parsed

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse)
    monkeypatch.setattr(sys, "path", list(sys.path))


def of(kind: str) -> dict[str, str]:
    return {command: page for command, page in FOUND.items() if re.match(kind, command) and command not in FOREIGN}


def test_commands_are_found() -> None:
    assert len(of(PROGRAM)) > 50 and len(of("python -m")) > 15 and len(of("python docs/")) > 8 and len(of("pip")) > 5
    assert (
        "shadowmap-dr pose --normals face --runs 10 --method shadows --shadow-only" in FOUND and not FOREIGN.keys() - FOUND.keys()
    )
    assert list(
        commands(
            "    shadowmap-dr soft \\\n        --full   # an hour\n\nor `python -m\nx --y`\n\n```python\n    python a.py\n```\n"
        )
    ) == [*("shadowmap-dr soft  --full", "python -m x --y")]


def test_the_program_understands_its_commands(tmp_path: Path) -> None:
    (tmp_path / "file.json").touch()
    program, wrong = typer.main.get_command(app), []
    for command, page in of(PROGRAM).items():
        for words in spelled(command, tmp_path / "file.json"):
            try:
                understood(program, PROGRAM, words[1:])
            except Exception as error:
                wrong.append(f"{page}: {' '.join(words)}: {getattr(error, 'message', error)!r}")
    assert not wrong, "\n".join(wrong)


def test_a_renamed_option_is_noticed() -> None:
    program = typer.main.get_command(app)
    understood(program, PROGRAM, ["pose", "--runs", "10"])
    errors = r"No such (option|command)|valid integer|Missing (argument|parameter)|unexpected extra"
    for words in (
        ["pose", "--starts", "10"],
        ["pose", "--runs", "ten"],
        ["gradients", "jacobi", "--out", "a"],
        ["face", "convert", "a"],
    ):
        with pytest.raises(Exception, match=errors):
            understood(program, PROGRAM, words)


@pytest.mark.filterwarnings("ignore:.*found in sys.modules:RuntimeWarning")
def test_scripts_understand_their_commands(
    tmp_path: Path, only_parsed: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file.json").touch()
    wrong = []
    for command, page in of("python").items():
        words = shlex.split(command.partition(" [")[0])
        module, script = words[1] == "-m", words[2] if words[1] == "-m" else words[1]
        if script in ("pytest", "sphinx", "shadowmap_dr.experiments.bench.report", "tests/test_layers.py"):
            continue  # below, and in tests/test_layers.py
        if script.endswith("torch_mesh.py") and importlib.util.find_spec("torch") is None:
            continue
        for spelling in spelled(command, tmp_path / "file.json"):
            monkeypatch.setattr(sys, "argv", spelling[2 if module else 1 :])
            monkeypatch.syspath_prepend(ROOT if module else (ROOT / script).parent)
            try:
                run: Any = runpy.run_module if module else runpy.run_path
                run(script if module else str(ROOT / script), run_name="__main__", **({"alter_sys": False} if module else {}))
                wrong.append(f"{page}: {' '.join(spelling)} ended without a look at its options")
            except Parsed:
                pass
            except SystemExit:
                if len(spelling) == 2 + module:
                    continue  # the name of a script alone is none to be typed
                wrong.append(f"{page}: {' '.join(spelling)}: {capsys.readouterr().err.strip().splitlines()[-1]}")
    assert not wrong, "\n".join(wrong)


def test_files_and_options_of_pytest_and_sphinx(pytestconfig: pytest.Config) -> None:
    for command in of(r"python -m pytest"):
        words = shlex.split(command)[3:]
        known, unknown = pytestconfig._parser.parse_known_and_unknown_args(words)
        assert not unknown, command
        assert all((ROOT / place).exists() for place in known.file_or_dir), command
    assert of("python -m sphinx")
    build = pytest.importorskip("sphinx.cmd.build", reason="Sphinx is not installed: pip install '.[docs]'")
    for command in of("python -m sphinx"):
        assert build.get_parser().parse_args(shlex.split(command)[3:]).sourcedir == "docs"


def test_extras_exist() -> None:
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8").partition("[project.optional-dependencies]")[2]
    extras = set(re.findall(r"^(\w+) = \[", project.partition("\n[")[0], re.MULTILINE))
    named = {
        extra for command in of("pip install") for part in re.findall(r"\.\[([\w,]+)\]", command) for extra in part.split(",")
    }
    assert len(named) > 5 and named <= extras


#: Commands of the pages that are run, with what makes them small; the last of an option's values counts.
SMALL = {
    "shadowmap-dr info": "",
    "shadowmap-dr render pose -D resolution=256 -o docs/first-picture.png": "--size 16x16 -o picture.png",
    "shadowmap-dr pose --runs 10 --method shadows": "--runs 1 --resolution 16 --iterations 2 --reference own --quiet",
    "shadowmap-dr lights": "--runs 2 --object spot --resolution 16 --iterations 2 --shadows --quiet",
    "shadowmap-dr maps": "--scene overlap --method vsm --resolution 32 --spp 4 --pose-runs 0 --quiet",
}


@pytest.mark.parametrize("command", SMALL)
def test_small_runs(command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert command in FOUND
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, [*shlex.split(command)[1:], *shlex.split(SMALL[command])])
    assert result.exit_code == 0, result.output
    made = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert made or "mitsuba" in result.output


@pytest.mark.filterwarnings("ignore:.*found in sys.modules:RuntimeWarning")
def test_the_table_of_the_benchmark(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["report", str(DOCS / "results" / "bench.json")])
    runpy.run_module("shadowmap_dr.experiments.bench.report", run_name="__main__")
    assert "| step with shadows | 128 |" in capsys.readouterr().out

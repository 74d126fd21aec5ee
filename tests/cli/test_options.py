"""Options of commands: made from the fields of records, each stated once."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
import typer

from shadowmap_dr.cli import main
from shadowmap_dr.cli.main import COMMANDS
from shadowmap_dr.cli.options import After, Given, Variant, from_record
from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.art.experiment import ArtOptions
from shadowmap_dr.experiments.bench.common import BenchOptions
from shadowmap_dr.experiments.faces.experiment import FaceOptions
from shadowmap_dr.experiments.gradients.convergence import ConvergenceOptions
from shadowmap_dr.experiments.gradients.jacobian import JacobianOptions
from shadowmap_dr.experiments.gradients.plane import PlaneOptions
from shadowmap_dr.experiments.lights.experiment import LightOptions
from shadowmap_dr.experiments.lights.speed import TimesOptions
from shadowmap_dr.experiments.maps.experiment import MapsOptions
from shadowmap_dr.experiments.pose.experiment import PoseOptions
from shadowmap_dr.experiments.soft.experiment import SoftOptions
from shadowmap_dr.fitting.options import FitOptions
from shadowmap_dr.importing import ImportOptions
from shadowmap_dr.interactive.options import ModelOptions
from shadowmap_dr.inverse.faces.convert import ConvertOptions
from shadowmap_dr.io.options import described, description, option, setting
from shadowmap_dr.io.ranges import check_ranges

# Records of the commands, and the parameters that are no fields of them.
RECORDS: dict[str, tuple[type[Any], set[str]]] = {
    "import": (ImportOptions, {"model", "output"}),
    "fit": (FitOptions, {"scene", "target", "mask", "define", "listing", "out", "resume", "variant"}),
    "soft": (SoftOptions, {"full", "variant"}),
    "lights": (LightOptions, {"shadows", "full", "variant"}),
    "lights-times": (TimesOptions, {"variant"}),
    "art": (ArtOptions, {"text", "variant"}),
    "model": (ModelOptions, {"mesh", "variant"}),
    "pose": (PoseOptions, {"variant"}),
    "maps": (MapsOptions, {"variant"}),
    "bench": (BenchOptions, {"variant"}),
    "gradients jacobian": (JacobianOptions, {"full", "variant"}),
    "gradients convergence": (ConvergenceOptions, {"full", "variant"}),
    "gradients minimal-plane": (PlaneOptions, {"variant"}),
    "face": (FaceOptions, {"image", "variant"}),
    "face convert": (ConvertOptions, {"source", "output"}),
}
# Commands whose options stand in their functions.
ALONE = {"info", "render"}


def commands() -> Iterator[tuple[str, Any]]:  # Any: Click's Command, by the version of Typer
    """All commands that do something, by the words that call them."""
    program = typer.main.get_command(main.app)
    for name in COMMANDS:
        command = program.get_command(None, name)  # type: ignore[attr-defined]
        if command.callback is not None:
            yield name, command
        for inner, one in getattr(command, "commands", {}).items():
            yield f"{name} {inner}", one


def single(function: Any) -> typer.Typer:
    """A program of one command."""
    program = typer.Typer(add_completion=False, rich_markup_mode=None)
    program.command()(function)
    return program


def test_each_option_is_a_field() -> None:
    found = dict(commands())
    assert set(found) == {*RECORDS, *ALONE}
    for name, (record, own) in RECORDS.items():
        parameters = [parameter for parameter in found[name].params if parameter.name != "help"]
        assert [parameter.name for parameter in parameters[-2:]] == ["quiet", "verbose"], name
        parameters = parameters[:-2]
        assert {parameter.name for parameter in parameters} == {*described(record), *own}, name
        assert all(parameter.help for parameter in parameters), name


@pytest.mark.parametrize("record", dict.fromkeys(record for record, _ in RECORDS.values()))
def test_each_field_has_a_help_text(record: type[Any]) -> None:
    for field in fields(record):
        assert description(field).help.endswith("."), field.name


def doubled(count: int) -> int:
    return 2 * count


@dataclass(frozen=True)
class Toy:
    """A record with an option of each kind."""

    kind: Literal["plain", "fancy"] = option("plain", help="Kind.")
    sizes: tuple[int, ...] = option((1, 2), names=("--size",), full=(8, 9), help="Size; repeatable.")
    levels: tuple[Literal["low", "high"], ...] = option(("low",), help="Level; repeatable.")
    factor: float | None = option(None, shown="chosen", help="Factor.")
    path: Path = option(Path("here"), metavar="FOLDER", help="Folder.")
    flag: bool = option(False, help="Flag.")
    checked: bool = option(True, help="Checks.")
    twice: int = option(6, parse=doubled, shown="3", help="Half of a number.")
    few: int = option(1, allowed=(0, 5), full=4, help="Few.")
    out: Path = option(Path("out"), help="Results.")
    hidden: int = setting(7, help="Not for the command line.")

    def __post_init__(self) -> None:
        check_ranges(self)


@pytest.fixture
def run() -> Any:
    """Calls a command with the record `Toy`; returns what its function gets."""
    seen: list[Any] = []

    @from_record(first=("out",), full="Larger.")
    def toy(
        name: Annotated[str, typer.Argument(help="Name.")],
        options: Toy,
        extra: Annotated[int, typer.Option(help="Extra."), After("kind")] = 0,
        variant: Variant = "v",
    ) -> None:
        """Do it."""
        seen.append((name, options, extra, variant))

    def call(*arguments: str) -> Any:
        typer.main.get_command(single(toy)).main(["a", *arguments], standalone_mode=False)
        return seen[-1]

    call.command = toy  # type: ignore[attr-defined]
    return call


def test_defaults_are_those_of_the_record(run: Any) -> None:
    assert run() == ("a", Toy(), 0, "v")


def test_values_of_all_kinds(run: Any) -> None:
    words = "--kind fancy --size 3 --size 4 --levels high --factor 0 --path there --flag --no-checked --twice 5 --few 0 --extra 2"
    made = Toy("fancy", (3, 4), ("high",), 0.0, Path("there"), True, False, 10, 0)
    assert run(*words.split(), "--variant", "w") == ("a", made, 2, "w")


def test_full_replaces_defaults_only(run: Any) -> None:
    assert run("--full")[1] == Toy(sizes=(8, 9), few=4)
    assert run("--full", "--size", "3", "--few", "1")[1] == Toy(sizes=(3,), few=1)


@pytest.mark.parametrize("words", ["--twice x", "--size x", "--hidden 1", "--no-flag"])
def test_bad_values(run: Any, words: str) -> None:
    with pytest.raises(Exception) as refused:
        run(*words.split())
    assert words.split()[0] in refused.value.format_message()  # type: ignore[attr-defined]


def test_numbers_out_of_range(run: Any) -> None:
    with pytest.raises(ShadowmapError, match=r"few \(--few\) is 6: give a whole number from 0 to 5\."):
        run("--few", "6")


def test_order_and_help(run: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    names = "name full out kind extra sizes levels factor path flag checked twice few variant"
    assert list(inspect.signature(run.command).parameters) == names.split()
    monkeypatch.setenv("COLUMNS", "200")
    typer.main.get_command(single(run.command)).main(["--help"], standalone_mode=False, terminal_width=200)
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    for line in (
        "--kind plain|fancy Kind. [default: plain]",
        "--levels low|high Level; repeatable. [default: low]",
        "--path FOLDER Folder. [default: here]",
        "--flag Flag.",
        "--checked / --no-checked Checks. [default: checked]",
    ):
        assert line in lines, lines
    for end in ("Size; repeatable. [default: 1, 2]", "Factor. [default: chosen]", "Half of a number. [default: 3]"):
        assert any(line.endswith(end) for line in lines), lines


def test_a_command_may_make_its_record_itself() -> None:
    given = Given(Toy, {"few": 3}, {"sizes": (8,)})
    assert "few" in given and "sizes" not in given
    assert (given["few"], given["sizes"], given["twice"]) == (3, (8,), 6)
    assert given.make(twice=2) == Toy(sizes=(8,), twice=2, few=3)

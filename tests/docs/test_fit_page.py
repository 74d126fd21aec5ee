"""The section of the command `fit`: its file and its tables are those of the program."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path

import pytest

from shadowmap_dr.fitting import FitOptions, Vary
from shadowmap_dr.fitting.judgement import EXPLAINED, EXPLAINED_CORRECTED
from shadowmap_dr.fitting.task import PictureFile, read_task
from shadowmap_dr.fitting.uncertainty import DISPLACEMENT, FACTOR
from shadowmap_dr.fitting.vary import KINDS

PAGE = Path(__file__).resolve().parents[2] / "docs" / "commands.md"

if not PAGE.is_file():
    pytest.skip("no documentation beside the tests", allow_module_level=True)

TEXT = PAGE.read_text(encoding="utf-8")


def test_example_of_a_file_is_read(tmp_path: Path) -> None:
    (example,) = re.findall(r"```toml\n(.*?)```", TEXT, re.DOTALL)
    (tmp_path / "fit.toml").write_text(example)
    task = read_task(tmp_path / "fit.toml")
    assert [vary.label for vary in task.options.vary] == ["bunny:rotation:y", "sun:direction", "bunny.bsdf.reflectance"]
    assert [picture.exposure for picture in task.pictures] == [1, 1.5] and task.options.starts == 16


def test_all_keys_and_kinds_are_in_the_tables() -> None:
    keys = TEXT.partition("### fit.toml")[2]
    plain = set(re.findall(r"^\| `(\w+)` \|", keys, re.MULTILINE))
    assert plain == {"scene", "parameters"} | {option.name for option in fields(FitOptions)} - {"vary"}
    for table, names in (("target", {one.name for one in fields(PictureFile)}), ("vary", set(Vary.of("a").plain()))):
        rows = re.findall(rf"^\| `{table}`: (.*?) \|", keys, re.MULTILINE)
        assert names <= {name for row in rows for name in re.findall(r"`(\w+)`", row)}
    for option in fields(FitOptions):
        if option.name != "vary":
            shown = str(option.default).lower()
            assert re.search(rf"^\| `{option.name}` \| `?{re.escape(shown)}`? \|", keys, re.MULTILINE), option.name
    kinds = re.findall(r"^\| `(\w+)` \|", TEXT.partition("### What varies")[2].partition("###")[0], re.MULTILINE)
    assert set(kinds) == set(KINDS)


def test_numbers_of_the_text_are_those_of_the_program() -> None:
    assert f"at most {100 * EXPLAINED_CORRECTED:g} % of the edges that matter" in TEXT
    assert f"({100 * EXPLAINED:g} % where\ntextures or vertices vary, or images are not corrected)" in TEXT
    assert f"displaced by {DISPLACEMENT:g} pixels, a brightness that is wrong by {100 * FACTOR:g} %" in TEXT

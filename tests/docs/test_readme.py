"""Promises of the README."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import mitsuba as mi
import pytest

import shadowmap_dr
from shadowmap_dr.integrator.options import Options
from shadowmap_dr.rendering.settings import AUTO

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def readme() -> str:
    path = ROOT / "README.md"
    if not path.is_file():
        pytest.skip("no README beside the tests")
    return path.read_text()


def python_blocks(readme: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", readme, re.DOTALL)


def test_python_examples_run(readme: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(ROOT)
    blocks = [block for block in python_blocks(readme) if "import torch" not in block]
    assert len(blocks) == 2
    names: dict[str, object] = {}
    for block in blocks:
        exec(compile(block, "README.md", "exec"), names)
    assert capsys.readouterr().out.startswith("[")
    assert names["image"].shape == (128, 128, 3)


def test_example_for_pytorch_finds_the_offset(readme: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("torch", reason="PyTorch is not installed: pip install '.[torch]'")
    monkeypatch.chdir(ROOT)
    (block,) = [block for block in python_blocks(readme) if "import torch" in block]
    names: dict[str, Any] = {}
    exec(compile(block, "README.md", "exec"), names)
    assert names["image"].shape == (128, 128, 3)
    assert 0 < names["offset"].norm() < 0.05  # of 0.14


def test_named_parameters_exist(readme: str) -> None:
    named = {"shadow_map_resolution", "shadow_method", "shadow_filter", "shadow_filter_size", "antialias", "aovs"}
    for name in named:
        assert f"`{name}`" in readme and hasattr(Options(), name)
    assert Options().shadow_map_resolution == AUTO and "(`auto`: as the film needs)" in " ".join(readme.split())
    assert shadowmap_dr.Renderer and mi.variants()


def test_named_files_exist(readme: str) -> None:
    for path in re.findall(r"\]\((docs/[^)]+)\)", readme) + ["scenes/meshes/SOURCES.md", "LICENSE"]:
        assert (ROOT / path).exists(), path


def test_it_is_short(readme: str) -> None:
    assert len(readme.split()) <= 900


def test_ci_finds_the_test_command(readme: str) -> None:
    script = (ROOT / ".ci" / "run").read_text()
    pattern = re.search(r"sed -n 's/(.*)/\\1/p'", script)
    assert pattern is not None
    commands = re.findall(r"^ *(pip install .*pytest.*)$", readme, re.MULTILINE)
    assert commands == ["pip install '.[test]' && python -m pytest -n 3 --dist loadfile tests"]

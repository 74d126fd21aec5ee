"""English of docstrings, as far as a program can read it."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
# A docstring names its thing, or says what to do: these begin riddles.
RIDDLES = {"What", "Where", "Which", "Whether", "How", "When"}


@pytest.mark.parametrize("folder", ["shadowmap_dr", "mitsuba_baselines", "tests", "docs/examples"])
def test_docstrings_begin_with_a_noun_phrase_or_an_imperative(folder: str) -> None:
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    found = []
    for path in sorted((ROOT / folder).rglob("*.py")):
        nodes = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, documented)]
        texts = [(getattr(node, "name", "module"), ast.get_docstring(node) or "") for node in nodes]
        found += [(path.name, name, text.splitlines()[0]) for name, text in texts if text.split(" ")[0] in RIDDLES]
    assert not found

"""The list of slow tests names tests that exist."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tests.slow import mean_seconds, slow_tests

TESTS = Path(__file__).parent


def test_all_slow_tests_exist() -> None:
    """``python -m tests.slow`` writes the list anew after tests were renamed."""
    names = slow_tests()
    assert len(names) > 100
    defined = {
        f"{path.relative_to(TESTS).as_posix()}::{node.name}"
        for path in TESTS.rglob("test_*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef)
    }
    assert not names.keys() - defined


def test_slow_tests_are_marked(request: pytest.FixtureRequest) -> None:
    for item in request.session.items:
        name = f"{item.path.relative_to(TESTS).as_posix()}::{item.originalname}"  # type: ignore[attr-defined]  # of functions
        assert (item.get_closest_marker("slow") is not None) == (name in slow_tests())


def test_times_are_means_of_the_cases_that_ran(tmp_path: Path) -> None:
    cases = (
        ("tests.io.test_a", "test_b[x]", 1.0, ""),
        ("tests.io.test_a", "test_b[y]", 2.0, ""),
        ("tests.io.test_a", "test_b[cuda]", 0.0, "<skipped/>"),
        ("tests.test_c", "test_d", 0.25, ""),
    )
    body = "".join(f'<testcase classname="{c}" name="{n}" time="{t}">{inner}</testcase>' for c, n, t, inner in cases)
    (tmp_path / "times.xml").write_text(f"<testsuites><testsuite>{body}</testsuite></testsuites>")
    assert mean_seconds(tmp_path / "times.xml") == {"io/test_a.py::test_b": 1.5, "test_c.py::test_d": 0.25}

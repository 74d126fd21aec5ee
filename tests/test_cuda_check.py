"""The report of `python -m tests.cuda_check`, which itself needs a GPU."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest

from tests import cuda_check


def test_counts_tests(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cases = '<testcase classname="a" name="one"/><testcase classname="a" name="two"><failure/></testcase>'
    report = f'<testsuites><testsuite>{cases}<testcase classname="a" name="three"><skipped/></testcase></testsuite></testsuites>'
    commands: list[list[str]] = []

    def run(command: list[str], **_: Any) -> None:
        commands.append(command)
        (tmp_path / "junit.xml").write_text(report)

    monkeypatch.setattr(subprocess, "run", run)
    assert cuda_check.run_tests(tmp_path / "junit.xml", 3) == {"run": 2, "skipped": 1, "failed": ["a::two"]}
    assert all(Path(part).is_dir() for part in commands[0][-len(cuda_check.TESTS) :])


def test_tests_that_did_not_run_have_failed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: None)
    assert cuda_check.run_tests(tmp_path / "junit.xml", 3)["failed"]


def test_table_has_what_was_measured_beside_the_paper(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    record = Path(__file__).parent.parent / "docs" / "results" / "bench.json"
    (tmp_path / "steps.json").write_text(record.read_text())
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: None)
    steps = cuda_check.run_steps(tmp_path / "steps.json")
    median = json.loads(record.read_text())["sections"]["steps"]["units"]["step-128"]["seconds"]["shadows"]["median"]
    assert steps["128"]["shadows"] == pytest.approx(1e3 * median)
    lines = cuda_check.table({"run": 5, "failed": []}, steps).splitlines()
    assert f"| 128 | {1e3 * median:.2f} ms |" in lines[4] and lines[4].endswith("| 14 ms |")

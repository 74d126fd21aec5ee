"""Random cases, few of them: ``python -m tests.fuzz`` runs many."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.fuzz import selftest
from tests.fuzz.kinds import KINDS, Case, Kind, spread
from tests.fuzz.outcome import FAULT, REFUSED, RESULT, Outcome
from tests.fuzz.report import Report
from tests.fuzz.runner import run_cases

ROOT = Path(__file__).parents[1]


def test_hundred_cases() -> None:
    names = [name for name, kind in KINDS.items() if not kind.slow and (not kind.needs or importlib.util.find_spec(kind.needs))]
    report = Report(100, quiet=True)
    run_cases(spread(100, 20_000, names), report.add)
    assert report.counts.total() == 100 and not report.faults, "; ".join(f"{o.text} ({c.command})" for c, o in report.faults)
    assert all(report.counts[name, RESULT] + report.counts[name, REFUSED] for name in names), report.table()


def test_cases_are_spread_by_share() -> None:
    cases = spread(1000, 7, list(KINDS))
    assert len(cases) == 1000 == len(set(cases)) and {case.kind for case in cases} == set(KINDS)
    again = Case("files", 12, 7)
    assert again.generator.random() == Case("files", 12, 7).generator.random() != Case("files", 12, 8).generator.random()
    assert again.command == "python -m tests.fuzz --seed 7 --kind files --case 12"


def test_every_end_of_a_case_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Faults do not keep the cases after them from being tried."""
    monkeypatch.setitem(KINDS, "selftest", Kind(1, seconds=1.5, megabytes=300))
    firsts: dict[str, Case] = {}
    for number in range(200):
        case = Case("selftest", number, 0)
        firsts.setdefault(selftest.behaviour(case.generator), case)
    assert set(firsts) == set(selftest.BEHAVIOURS)
    found: dict[Case, Outcome] = {}
    cases = [firsts[name] for name in selftest.BEHAVIOURS]
    run_cases([*cases, *cases[:2]], found.__setitem__)
    kinds = {name: (found[case].kind, found[case].text) for name, case in firsts.items()}
    assert kinds["result"] == (RESULT, "as it should be") and kinds["refusal"] == (REFUSED, "a bad value: give another.")
    for name, words in {
        "long refusal": "several lines",
        "error": r"KeyError: 'none' \(.*selftest\.py:\d+\)",
        "wrong": "wrong result: two is three",
        "warning": "RuntimeWarning: overflow",
        "signal": r"signal 11 \(SIGSEGV\).*selftest\.py",
        "exit": "exit status 3",
        "hang": r"no end after 2 s \(.*selftest\.py:\d+",
        "memory": "memory grew by",
    }.items():
        kind, text = kinds[name]
        assert kind == FAULT and re.search(words, text), (name, text)


def test_the_command_writes_counts(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tests.fuzz", "--cases", "3", "--kind", "files", "--out", str(tmp_path / "a.json")]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    record = json.loads((tmp_path / "a.json").read_text())
    assert run.returncode == 0 and "| files | 3 |" in run.stdout, run.stderr
    assert sum(record["counts"]["files"].values()) == 3 and record["faults"] == []

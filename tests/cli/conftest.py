"""The command line program in this process."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

from shadowmap_dr.cli import main


class Result:
    def __init__(self, status: int, out: str, err: str) -> None:
        self.status, self.out, self.err = status, out, err


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Any:
    """Runs the program in this process, in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments: str) -> Result:
        monkeypatch.setattr(sys, "argv", ["shadowmap-dr", *arguments])
        capsys.readouterr()
        with pytest.raises(SystemExit) as exit_:
            main.main()
        out, err = capsys.readouterr()
        return Result(int(exit_.value.code or 0), out, err)

    return call

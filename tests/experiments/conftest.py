"""Fixtures of the experiments' tests."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure


@pytest.fixture(autouse=True)
def quick_figures(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Draws figures at a low resolution and without fitting their margins, which takes most of an experiment's small run."""
    save = Figure.savefig

    def savefig(figure: Figure, file: Any, **options: Any) -> None:
        figure.set_layout_engine("none")
        save(figure, file, **{**options, "dpi": 30})

    monkeypatch.setattr(Figure, "savefig", savefig)
    yield


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """The pose experiment without its plots, which take longer than small runs."""
    from shadowmap_dr.experiments.pose import experiment

    monkeypatch.setattr(experiment, "_plots", lambda *_: None)
    monkeypatch.setattr(experiment, "draw", lambda path, *_: Path(path).touch())

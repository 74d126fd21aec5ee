"""Files of a fit's state: they come back as they were, and others, also with right digests, are refused in one line."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.fitting.result import Step
from shadowmap_dr.fitting.state import Run, Sizes, State
from shadowmap_dr.io.checkpoints import write_checkpoint
from shadowmap_dr.io.files import read_arrays

SIZES = Sizes(2, 3, (4,))
STEP: Step = {"start": 0, "stage": "12 px", "step": 0, "error": math.inf, "seconds": 0.5}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """The file of a state of two starts and a texture."""
    runs = [Run(0, np.array([0.5, 1]), 2.0, 1, trail=[(0, np.zeros(2)), (1, np.ones(2))]), Run(1, np.zeros(2))]
    State(runs, [STEP], 1, [np.ones(4, np.float32)]).write(tmp_path / "fit.npz", "this fit")
    return tmp_path / "fit.npz"


def test_states_come_back(path: Path) -> None:
    found = State.read(path, "this fit", SIZES)
    assert [(run.number, run.cost, run.stage, run.x.tolist()) for run in found.runs] == [
        (0, 2, 1, [0.5, 1]),
        (1, math.inf, -1, [0, 0]),
    ]
    assert [(stage, x.tolist()) for stage, x in found.runs[0].trail] == [(0, [0, 0]), (1, [1, 1])]
    assert found.history == [STEP] and found.array_stage == 1 and found.values[0].tolist() == [1, 1, 1, 1]


def test_of_starts_that_have_met_one_goes_on() -> None:
    places = {0: (0.5, 1), 1: (0.5, 1.001), 2: (0.5, 1.5), 3: (0.501, 1), 4: (-1, 0)}
    costs = {0: 1.0, 1: 1.001, 2: 1.002, 3: 1.2, 4: 3.0}
    runs = [Run(k, np.array(places[k], float), costs[k], 0, trail=[(0, np.zeros(2))]) for k in places]
    state = State(runs, [STEP], 0, [])
    state.choose(0, 2)
    assert [run.number for run in state.going(1)] == [0, 2, 3]


NUMBERS = np.array([[0, 1, 9, 0], [1, -1, 9, 0]])


@pytest.mark.parametrize(
    "changes",
    [
        {"x": np.zeros((2, 3))},
        {"x": np.zeros((2, 2), complex)},
        {"x": np.full((2, 2), "1")},
        {"x": np.full((2, 2), np.nan)},
        {"x": np.full((2, 2), 1e300)},
        {"trail_x": np.full((2, 2), np.inf)},
        {"trail": np.array([[0, 0], [0, 3]])},
        {"trail": np.array([[0, 0], [0, -1]])},
        {"trail": np.array([[0, 0], [7, 0]])},
        {"numbers": NUMBERS.astype(float)},
        {"numbers": NUMBERS + 2},
        {"numbers": NUMBERS[:1]},
        {"costs": np.array([1.0, np.nan])},
        {
            "numbers": NUMBERS[:0],
            "costs": np.zeros(0),
            "x": np.zeros((0, 2)),
            "trail": NUMBERS[:0, :2],
            "trail_x": np.zeros((0, 2)),
        },
        {"array_stage": np.array(-5)},
        {"array_stage": np.array(4)},
        {"array_stage": np.array([1])},
        {"values0": np.zeros(3, np.float32)},
        {"values0": np.full(4, np.nan, np.float32)},
        {"values0": None},
        {"history": np.array("")},
        {"history": np.array("null")},
        {"history": np.array("[NaN]")},
        {"history": np.array("[{}]")},
        {"history": np.array("[" * 100_000)},
        {"history": np.array(json.dumps([{**STEP, "seconds": math.nan}]))},
        {"history": np.array(json.dumps([{**STEP, "start": "0"}]))},
    ],
    ids=lambda changes: " ".join(f"{name}={value!r:.40}" for name, value in changes.items()),
)
def test_states_of_no_fit_are_refused(path: Path, changes: dict[str, Any]) -> None:
    arrays = {name: array for name, array in read_arrays(path).items() if name not in ("fingerprint", "checks")}
    edited = {name: array for name, array in {**arrays, **changes}.items() if array is not None}
    write_checkpoint(path, "this fit", edited)
    with pytest.raises(
        ShadowmapError, match=r"cannot read the checkpoint .*fit\.npz: it was edited or is damaged; delete it"
    ) as raised:
        State.read(path, "this fit", SIZES)
    assert "\n" not in str(raised.value)

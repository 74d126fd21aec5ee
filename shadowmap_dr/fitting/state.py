"""State of a fit: its starts on their way, and its file, from which a fit that was killed goes on."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import numpy.typing as npt

from ..io.checkpoints import read_checkpoint, unreadable, write_checkpoint
from .result import Step
from .starts import going_on

Array = npt.NDArray[np.float64]


# Types of the entries of a step, and a number that none of a fit reaches.
_STEP, _MOST = get_type_hints(Step), 1e30
# Starts have met whose losses differ by less than this share, and whose numbers by less than this.
_SAME_COST, _SAME_PLACE = 0.01, 0.02


@dataclass(frozen=True)
class Sizes:
    """Sizes of a fit: its numbers, stages, and values of each texture and mesh."""

    numbers: int
    stages: int
    values: tuple[int, ...]


@dataclass
class Run:
    """A start on its way.

    Attributes:
        number: of the start.
        x: current numbers (n,).
        cost: loss in the last stage.
        stage: last stage that is done, -1 for none.
        last: last stage that it is to take part in.
        corrected: True after the steps with corrected images.
        trail: (stage, numbers) of all steps.
    """

    number: int
    x: Array
    cost: float = math.inf
    stage: int = -1
    last: int = 1 << 30
    corrected: bool = False
    trail: list[tuple[int, Array]] = field(default_factory=list)


@dataclass
class State:
    """The starts; the errors of all steps; values of textures and vertices, and the first stage in which they are not fitted."""

    runs: list[Run]
    history: list[Step]
    array_stage: int
    values: list[npt.NDArray[np.float32]]

    @property
    def best(self) -> Run:
        """The start with the smallest loss of those that came farthest."""
        return self.best_from(0)

    def best_from(self, first: int) -> Run:
        """The same of the starts from number ``first`` on."""
        return min((run for run in self.runs if run.number >= first), key=lambda run: (-run.stage, not run.corrected, run.cost))

    def going(self, stage: int) -> list[Run]:
        """Starts that have a stage before them."""
        return [run for run in self.runs if run.stage < stage <= run.last]

    def choose(self, stage: int, left: int, first: int = 0) -> None:
        """Choose the starts that go on, of those from number ``first`` on, after a stage which ``left`` others but the next one
        follow. Of those that have met, one does."""
        # Not those that begin with the next stage, nor those of a file that were not chosen.
        done = [run for run in self.runs if run.number >= first and run.stage == stage and run.trail and run.last > stage]
        if left < 0:
            return
        on = list[Run]()
        for k in going_on([run.cost for run in done], left):
            if not any(_is_same(done[k], other) for other in on):
                on.append(done[k])
        numbers = {run.number for run in on}
        for run in done:
            run.last = 1 << 30 if run.number in numbers else stage

    def write(self, path: Path, fingerprint: str) -> None:
        """Write the state. ``fingerprint``: text that identifies the fit."""
        trail = [(run.number, stage, x) for run in self.runs for stage, x in run.trail]
        count = len(self.runs[0].x)
        write_checkpoint(
            path,
            fingerprint,
            {
                "numbers": [[run.number, run.stage, run.last, run.corrected] for run in self.runs],
                "costs": [run.cost for run in self.runs],
                "x": np.array([run.x for run in self.runs]).reshape(len(self.runs), count),
                "trail": np.array([entry[:2] for entry in trail], np.int64).reshape(-1, 2),
                "trail_x": np.array([entry[2] for entry in trail]).reshape(len(trail), count),
                "history": np.array(json.dumps(self.history)),
                "array_stage": self.array_stage,
                **{f"values{k}": own for k, own in enumerate(self.values)},
            },
        )

    @classmethod
    def read(cls, path: Path, fingerprint: str, sizes: Sizes) -> State:
        """Read a state of a fit of some sizes.

        Raises:
            ShadowmapError: The file is damaged, or of another fit.
        """
        arrays = read_checkpoint(path, fingerprint)
        try:
            _check(arrays, sizes)
            runs = [
                Run(int(number), x, float(cost), int(stage), int(last), bool(corrected))
                for (number, stage, last, corrected), cost, x in zip(arrays["numbers"], arrays["costs"], arrays["x"], strict=True)
            ]
            by_number = {run.number: run for run in runs}
            for (number, stage), x in zip(arrays["trail"], arrays["trail_x"], strict=True):
                by_number[int(number)].trail.append((int(stage), x))
            values = [arrays[f"values{k}"] for k in range(len(sizes.values))]
            return cls(runs, _history(str(arrays["history"])), int(arrays["array_stage"]), values)
        except (KeyError, ValueError, TypeError, AttributeError, RecursionError) as error:
            raise unreadable(path) from error


def _is_same(one: Run, other: Run) -> bool:
    """True for starts that have met: both are on the way to the same place."""
    alike = abs(one.cost - other.cost) <= _SAME_COST * min(one.cost, other.cost)
    return alike and float(np.abs(one.x - other.x).max(initial=0)) <= _SAME_PLACE


def _check(arrays: Mapping[str, npt.NDArray[Any]], sizes: Sizes) -> None:
    """ValueError for arrays of other types or shapes than those of a fit, and for values that no fit has."""
    numbers, costs, x, trail, trail_x = (arrays[name] for name in ("numbers", "costs", "x", "trail", "trail_x"))
    values = [arrays[f"values{k}"] for k in range(len(sizes.values))]
    shapes = {
        "numbers": (numbers, "i", (len(costs), 4)),
        "costs": (costs, "f", (len(costs),)),
        "x": (x, "f", (len(costs), sizes.numbers)),
        "trail": (trail, "i", (len(trail), 2)),
        "trail_x": (trail_x, "f", (len(trail), sizes.numbers)),
        "array_stage": (arrays["array_stage"], "i", ()),
        **{f"values{k}": (own, "f", (sizes.values[k],)) for k, own in enumerate(values)},
    }
    for name, (array, kind, shape) in shapes.items():
        if array.dtype.kind != kind or array.shape != shape:
            raise ValueError(f"{name}: {array.dtype} {array.shape}")
    # Numbers become single-precision ones.
    finite = all(np.isfinite(one).all() and np.abs(one).max(initial=0) < _MOST for one in (x, trail_x, *values))
    stages = all(((one >= least) & (one < sizes.stages)).all() for one, least in ((numbers[:, 1], -1), (trail[:, 1], 0)))
    if not finite or not stages or not len(costs) or np.isnan(costs).any() or not 0 <= arrays["array_stage"] <= sizes.stages:
        raise ValueError("values that no fit has")


def _history(text: str) -> list[Step]:
    """Errors of all steps. ValueError for other JSON."""
    history = json.loads(text)
    for step in history:
        if {name: type(value) for name, value in step.items()} != _STEP or not math.isfinite(step["seconds"]):
            raise ValueError("no step")
    return list[Step](history)

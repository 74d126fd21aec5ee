"""The optimisation loop: it times steps, keeps losses on the device, and resumes killed runs from checkpoints."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import drjit as dr
import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...io.checkpoints import read_checkpoint, unreadable, write_checkpoint
from ...io.records import plain
from ...jit.types import Float
from ...rendering.receivers.checks import real_array

WARM_UP_STEPS = 5
CHECKPOINT_INTERVAL = 10

FloatArray = npt.NDArray[np.float64]
#: One or more numbers, on the host or the device.
Numbers: TypeAlias = "float | npt.NDArray[Any] | Float"


class Method(Protocol):
    """An estimator of a few parameters that works step by step.

    `step` and `parameters` may return Dr.Jit arrays: the loop reads them back only at checkpoints, so that steps do not wait for
    read-backs.
    """

    def reset(self, start: npt.ArrayLike) -> None:
        """Restart from the given parameters, with empty optimiser moments."""

    def step(self) -> Numbers:
        """Take one step. Returns the loss *before* the step (a number or an array with one entry)."""

    def parameters(self) -> Numbers:
        """Current parameters, an array (P,)."""

    def render(self, parameters: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """Linear image (H, W, C) for the given parameters."""

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Parameters and optimiser moments, from which `load_state` continues exactly."""

    def load_state(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Continue from a result of `state`, possibly of another process."""

    def describe(self) -> dict[str, Any]:
        """Settings for the record, as JSON values."""


@dataclass(frozen=True)
class History:
    """Course of N steps.

    Attributes:
        loss: (N,), the loss before each step.
        parameters: (N + 1, P), the start and the parameters after each step.
        seconds: (N,), wall-clock time of each step, including the device's work.
        warm: (N,) bool, False for the first five steps of each process, which compile and fill caches.
    """

    loss: FloatArray
    parameters: FloatArray
    seconds: FloatArray
    warm: npt.NDArray[np.bool_]

    @property
    def iterations(self) -> int:
        return len(self.loss)

    @property
    def final(self) -> FloatArray:
        """(P,) parameters after the last step."""
        return self.parameters[-1]

    @property
    def seconds_per_iteration(self) -> float:
        """Median time of a step after the warm-up, or of all steps if all belong to the warm-up; NaN without steps.

        Steps after the last change of the parameters do not count: a method that has ended does nothing in them.
        """
        if not len(self.seconds):
            return float("nan")
        moved = np.flatnonzero((self.parameters[1:] != self.parameters[:-1]).any(1))
        count = int(moved[-1]) + 1 if len(moved) else len(self.seconds)
        seconds, warm = self.seconds[:count], self.warm[:count]
        return float(np.median(seconds[warm] if warm.any() else seconds))

    @property
    def seconds_total(self) -> float:
        return float(self.seconds.sum())


def optimize(
    method: Method,
    start: npt.ArrayLike,
    iterations: int,
    *,
    checkpoint: Path | None = None,
    settings: Mapping[str, Any] | None = None,
    on_step: Callable[[int], None] | None = None,
) -> History:
    """Run `iterations` steps of a method.

    Args:
        method: see Method.
        start: (P,) start parameters.
        iterations: number of steps, at least 1.
        checkpoint: file that is written every ten steps, and from which the run resumes if it exists. It stays after the last
            step.
        settings: JSON values that identify the run; a checkpoint with other settings is an error.
        on_step: called with the number of finished steps.

    Raises ShadowmapError if the checkpoint belongs to another run, has more steps, or cannot be read or written.
    """
    if iterations < 1:
        raise ShadowmapError(f"{iterations} iterations: at least one is needed.")
    fingerprint = json.dumps(plain(settings or {}), sort_keys=True)
    history = History(np.empty(0), real_array("start", start, np.float64).reshape(1, -1), np.empty(0), np.empty(0, np.bool_))
    state = None
    if checkpoint is not None and checkpoint.exists():
        history, state = _load(checkpoint, fingerprint)
        if not np.array_equal(history.parameters[0], np.ravel(start)):
            raise ShadowmapError(f"the checkpoint {checkpoint} began elsewhere: delete it or choose another file.")
        if history.iterations > iterations:
            raise ShadowmapError(
                f"the checkpoint {checkpoint} has {history.iterations} steps: delete it, or ask for at least as many."
            )
    if state is None:
        method.reset(start)
    else:
        try:
            method.load_state(state)
        except KeyError as error:
            raise ShadowmapError(f"the checkpoint {checkpoint} lacks {error}: delete it to start this run anew.") from error
    if history.iterations >= iterations:
        return history

    losses: list[Numbers] = []
    parameters: list[Numbers] = []
    seconds: list[float] = []
    first = history.iterations
    for i in range(first, iterations):
        began = time.perf_counter()
        loss = method.step()
        dr.sync_thread()
        seconds.append(time.perf_counter() - began)
        losses.append(loss)
        parameters.append(method.parameters())
        done = i + 1
        if done == iterations or (checkpoint is not None and done % CHECKPOINT_INTERVAL == 0):
            warm = np.arange(done - len(losses), done) >= first + WARM_UP_STEPS
            history = History(
                np.concatenate([history.loss, [float(np.asarray(loss).reshape(-1)[0]) for loss in losses]]),
                np.concatenate([history.parameters, [np.asarray(entry, np.float64) for entry in parameters]]),
                np.concatenate([history.seconds, seconds]),
                np.concatenate([history.warm, warm]),
            )
            losses, parameters, seconds = [], [], []
            if checkpoint is not None:
                _save(checkpoint, fingerprint, history, method.state())
        if on_step is not None:
            on_step(done)
    return history


def _save(path: Path, fingerprint: str, history: History, state: Mapping[str, npt.NDArray[Any]]) -> None:
    arrays = {f"state/{name}": np.asarray(array) for name, array in state.items()}
    write_checkpoint(path, fingerprint, arrays | {f"history/{name}": array for name, array in vars(history).items()})


def _load(path: Path, fingerprint: str) -> tuple[History, dict[str, npt.NDArray[Any]]]:
    arrays = read_checkpoint(path, fingerprint)
    try:
        history = History(**{k.removeprefix("history/"): v for k, v in arrays.items() if k.startswith("history/")})
    except TypeError as error:
        raise unreadable(path) from error
    return history, {k.removeprefix("state/"): v for k, v in arrays.items() if k.startswith("state/")}

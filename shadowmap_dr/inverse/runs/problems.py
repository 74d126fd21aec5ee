"""Problems of a sweep: settings, numbered runs, objects that are built once, and a function that does a batch of runs.

Derive from :class:`LossProblem` if the loss can be evaluated for many runs at once, from :class:`MethodProblem` if a
:class:`shadowmap_dr.inverse.Method` does one run at a time, or from :class:`Problem` otherwise. A problem is a description: a
frozen dataclass of plain values that can be pickled and sent to workers. Method ``build`` makes everything that is expensive or
lives on a device.
"""

from __future__ import annotations

import dataclasses
import functools
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...jit.arrays import device_array
from ...jit.types import Float
from .loop import History, Method, optimize

FloatArray = npt.NDArray[np.float64]


class Problem(ABC):
    """Numbered runs that share settings and objects. Subclasses have these fields, properties or class attributes:

    Attributes:
        name: name in files and progress bars: letters, digits, '.', '_' and '-'.
        runs: number of runs, counted from 0 unless ``run_numbers`` says otherwise.
        steps: number of steps of each run.
    """

    # Read-only for type checkers, so that subclasses may compute them.
    if TYPE_CHECKING:

        @property
        def name(self) -> str: ...
        @property
        def runs(self) -> int: ...
        @property
        def steps(self) -> int: ...

    def settings(self) -> dict[str, Any]:
        """JSON values that the results depend on: records on disk with other settings are not used for these runs.

        Default: the number of steps and all fields of the dataclass except the number of runs.
        """
        if not dataclasses.is_dataclass(self):
            raise ShadowmapError(f"problem '{self.name}' is no dataclass: give it a method settings().")
        own = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "runs"}
        return {"steps": self.steps, **own}

    def run_numbers(self) -> Sequence[int]:
        """Numbers of the runs, in the order of the results."""
        return range(self.runs)

    def batch_size(self, memory: int) -> int:
        """Number of runs in a batch that needs at most about ``memory`` bytes."""
        return 1

    @abstractmethod
    def build(self) -> Any:  # Any: each problem builds its own type
        """Make the objects that batches share (scene, renderer, compiled steps), once in each process, with the variant set."""

    @abstractmethod
    def run_batch(
        self,
        built: Any,  # Any: result of `build`
        runs: Sequence[int],
        checkpoint: Path | None,
        on_step: Callable[[int], None],
    ) -> list[dict[str, Any]]:
        """Do some runs.

        Args:
            built: result of :meth:`build`.
            runs: their numbers. The result of a run depends on its number alone, not on the other runs of the batch.
            checkpoint: file from which a killed batch can resume, None for no checkpoints. Further files may lie beside it, with
                names that begin with its stem. All are deleted when the result is on disk.
            on_step: to be called with the number of finished steps.

        Returns:
            A record of JSON values for each run.
        """


class LossProblem(Problem):
    """Minimisation of a loss over P parameters from the start of each run, with Adam.

    A batch of R runs holds R P parameters in one array, run by run, and Adam's moments for each of them.
    """

    step_size: float = 0.01
    betas: tuple[float, float] = (0.9, 0.999)
    #: Approximate memory of one run of a batch, in bytes.
    bytes_per_run: int = 1 << 20

    def settings(self) -> dict[str, Any]:
        return {"step_size": self.step_size, "betas": list(self.betas), **super().settings()}

    @abstractmethod
    def start(self, run: int) -> npt.ArrayLike:
        """Start (P,) of a run; depends on its number only."""

    @abstractmethod
    def losses(self, built: Any, parameters: Float, runs: Sequence[int]) -> Float:  # Any: result of `build`
        """Loss of each of R runs, ``Float`` (R,). Attached to ``parameters``, ``Float`` (R P): each loss to those of its run."""

    def record(self, run: int, history: History) -> dict[str, Any]:
        """Record of a run: start, final parameters and the loss before each step."""
        return {"start": history.parameters[0], "final": history.final, "loss_curve": history.loss}

    def batch_size(self, memory: int) -> int:
        return max(1, memory // self.bytes_per_run)

    def run_batch(
        self,
        built: Any,  # Any: result of `build`
        runs: Sequence[int],
        checkpoint: Path | None,
        on_step: Callable[[int], None],
    ) -> list[dict[str, Any]]:
        starts = np.stack([np.asarray(self.start(run), np.float64).ravel() for run in runs])
        fit = _BatchFit(functools.partial(self.losses, built, runs=tuple(runs)), len(runs), self.step_size, self.betas)
        settings = {"settings": self.settings(), "runs": list(runs)}
        history = optimize(fit, starts.ravel(), self.steps, checkpoint=checkpoint, settings=settings, on_step=on_step)
        parameters = history.parameters.reshape(len(history.parameters), *starts.shape)
        losses = fit.loss_curves()
        records = []
        for k, run in enumerate(runs):
            own = losses[:, k].astype(np.float64)
            records.append(self.record(run, History(own, parameters[:, k], history.seconds / len(runs), history.warm)))
        return records


class MethodProblem(Problem):
    """Runs that a :class:`shadowmap_dr.inverse.Method`, such as `PoseFit`, does one by one; ``build`` returns the method."""

    @abstractmethod
    def start(self, run: int) -> npt.ArrayLike:
        """Start (P,) of a run; depends on its number only."""

    def record(self, run: int, history: History) -> dict[str, Any]:
        """Record of a run: start, final parameters, the loss before each step and the time of a step."""
        return {
            "start": history.parameters[0],
            "final": history.final,
            "loss_curve": history.loss,
            "seconds_per_iteration": history.seconds_per_iteration,
        }

    def run_batch(
        self, built: Method, runs: Sequence[int], checkpoint: Path | None, on_step: Callable[[int], None]
    ) -> list[dict[str, Any]]:
        records = []
        for run in runs:
            own = None if checkpoint is None else checkpoint.with_name(f"{checkpoint.stem}-run{run}{checkpoint.suffix}")
            settings = {"settings": self.settings(), "run": run}
            history = optimize(built, self.start(run), self.steps, checkpoint=own, settings=settings, on_step=on_step)
            records.append(self.record(run, history))
        return records


class _BatchFit:
    """Adam on all parameters of a batch: a `Method` of the optimisation loop whose loss is the sum of all runs' losses."""

    def __init__(self, losses: Callable[[Float], Float], runs: int, step_size: float, betas: tuple[float, float]) -> None:
        self._loss, self._runs, self._step_size, self._betas = losses, runs, step_size, betas
        self._losses: list[Float] = []
        self._parameters: Float
        self._m: Float
        self._v: Float
        self._t: Float
        self.reset(np.zeros(1))

    def loss_curves(self) -> npt.NDArray[np.float32]:
        """(N, R) losses before each step."""
        return np.array([np.array(loss) for loss in self._losses], np.float32)

    def reset(self, start: npt.ArrayLike) -> None:
        start = np.asarray(start, np.float32)
        zero = np.zeros_like(start)
        self.load_state({"parameters": start, "m": zero, "v": zero, "t": np.zeros(1), "losses": np.empty(0)})

    def step(self) -> Float:
        parameters = mi.Float(self._parameters)
        dr.enable_grad(parameters)
        losses = self._loss(parameters)
        if dr.width(losses) != self._runs:
            raise ShadowmapError(f"losses returned {dr.width(losses)} numbers for {self._runs} runs: give one for each.")
        dr.backward(dr.sum(losses))
        gradient = dr.grad(parameters)
        losses = dr.detach(losses)
        first, second = self._betas
        self._t = self._t + 1
        self._m = first * self._m + (1 - first) * gradient
        self._v = second * self._v + (1 - second) * gradient * gradient
        unbiased = 1 - cast(Float, dr.power(second, self._t))
        rate = self._step_size * dr.sqrt(unbiased) / (1 - cast(Float, dr.power(first, self._t)))
        self._parameters = self._parameters - rate * self._m / (dr.sqrt(self._v) + 1e-8)
        dr.eval(self._parameters, self._m, self._v, self._t, losses)
        self._losses.append(losses)
        return dr.sum(losses)

    def parameters(self) -> Float:
        return self._parameters

    def render(self, parameters: npt.ArrayLike) -> npt.NDArray[np.float32]:
        raise ShadowmapError("a batch of losses has no images: render them from its records.")

    def state(self) -> dict[str, npt.NDArray[Any]]:
        state = {"parameters": self._parameters, "m": self._m, "v": self._v, "t": self._t}
        return {"losses": self.loss_curves(), **{name: np.array(value) for name, value in state.items()}}

    def load_state(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        values = (device_array(mi.Float, state[name]) for name in ("parameters", "m", "v", "t"))
        self._parameters, self._m, self._v, self._t = values
        self._losses = list(state["losses"])

    def describe(self) -> dict[str, Any]:
        return {"optimizer": "Adam", "step_size": self._step_size, "betas": list(self._betas)}

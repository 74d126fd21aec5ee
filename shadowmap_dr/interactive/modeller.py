"""A sculptor that stops once its shadow matches the target, and goes on when the target changes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError
from ..inverse import Sculptor
from ..jit.types import Float
from .start_mesh import StartMesh

#: The modeller rests once the loss has not fallen by the share IMPROVEMENT, and by the amount LEAST, for PATIENCE steps, and
#: after MOST_STEPS steps at the latest. At 256 x 256 pixels, LEAST is a fifth of the loss of one wrong pixel.
IMPROVEMENT, LEAST, PATIENCE, MOST_STEPS = 0.02, 3e-6, 60, 600
# A target whose darkest pixel is lighter has no shadow. A mesh that followed it would shrink to nothing.
_LIT = 0.998
# Reading the loss waits for the device, so it is read only every few steps.
_LOOK_EVERY = 5

Array = npt.NDArray[np.float32]


@dataclass(frozen=True)
class ModellerState:
    """The mesh, the optimiser, and the progress towards the target at one moment. The target itself is not part of it."""

    sculptor: Mapping[str, npt.NDArray[Any]]  # see `Sculptor.state`
    moving: bool
    loss: float
    steps: int
    best_at: int
    best: float

    @property
    def bytes(self) -> int:
        """Bytes of all arrays."""
        return sum(array.nbytes for array in self.sculptor.values())

    @property
    def finite(self) -> bool:
        return all(bool(np.isfinite(array).all()) for array in self.sculptor.values())


class Modeller:
    """Lets a `Sculptor` of one view follow a target that may change at any time. Use it in one thread, like the sculptor.

    It is at rest at first, since a mesh matches its own shadow. It also rests while the target has no shadow at all.

    Args:
        sculptor: with one view.
        start: mesh that the sculptor begins with, for those who watch.
    """

    def __init__(self, sculptor: Sculptor, start: StartMesh | None = None) -> None:
        if len(sculptor.views) != 1:
            raise ShadowmapError(f"a sculptor of {len(sculptor.views)} views: painting needs exactly one.")
        self.sculptor, self.start = sculptor, start
        self._blank = False
        self.moving = False
        self.loss = 0.0
        self._steps = self._best_at = 0
        self._best = np.inf

    def set_target(self, image: npt.ArrayLike, wake: bool = True) -> None:
        """Replace the target by a visibility image (H, W).

        Raises ShadowmapError, and keeps the old target, if the image cannot be used.

        Args:
            image: 0 (dark) to 1 (lit).
            wake: follow the target from now on. False: for a target that the loaded state has followed already.
        """
        self.sculptor.set_target(0, image)
        self._blank = bool(np.min(image) > _LIT)
        if self._blank:
            self.moving = False
        elif wake:
            self.wake()

    def reset(self, vertices: npt.ArrayLike | None = None) -> None:
        """Go back to the first mesh, or to vertices (V, 3). The target stays."""
        self.sculptor.reset(vertices)
        self.wake()

    def wake(self) -> None:
        """Follow the target, even if the loss has not fallen lately. A target without any shadow is not followed."""
        if self._blank:
            self.moving = False
            return
        if not self.moving:
            # Adam's moments are of an older target, and would make the first steps towards this one small.
            self.sculptor.calm()
        self.moving = True
        self._steps = self._best_at = 0
        self._best = np.inf

    def state(self) -> ModellerState:
        """A copy of everything that `load_state` needs."""
        return ModellerState(self.sculptor.state(), self.moving, self.loss, self._steps, self._best_at, self._best)

    def load_state(self, state: ModellerState) -> None:
        """Go back to a result of `state`: the same vertices, moving or at rest as then. The target stays as it is now."""
        self.sculptor.load_state(state.sculptor)
        self.moving, self.loss = state.moving and not self._blank, state.loss
        self._steps, self._best_at, self._best = state.steps, state.best_at, state.best

    def step(self) -> bool:
        """Take one step, unless the mesh is at rest. Returns True if there was a step.

        Raises ShadowmapError when vertices are not finite any more.
        """
        if not self.moving:
            return False
        loss = self.sculptor.step()
        self._steps += 1
        if self._steps % _LOOK_EVERY == 0:
            self._judge(loss)
        return True

    def vertices(self) -> Array:
        """(V, 3), world space."""
        return self.sculptor.vertices()

    def shadow(self) -> Array:
        """(H, W), visibility from 0 (dark) to 1 (lit)."""
        return self.sculptor.visibility()[0]

    def _judge(self, loss: Float) -> None:
        """Rest if the loss does not fall any more."""
        self.loss = float(loss[0])
        if not np.isfinite(self.loss):
            raise ShadowmapError("the mesh has been lost: its vertices are not finite any more.")
        if self.loss < min((1 - IMPROVEMENT) * self._best, self._best - LEAST):
            self._best, self._best_at = self.loss, self._steps
        self.moving = self._steps - self._best_at < PATIENCE and self._steps < MOST_STEPS

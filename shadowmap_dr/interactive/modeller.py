"""A sculptor that stops when its shadow is as wanted, and wakes when something else is wanted."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError
from ..inverse import Sculptor
from ..jit.types import Float

#: It rests once the loss has not fallen by this share, and by this much, for so many steps; and after so many steps at last. At
#: 256 x 256 pixels, the second is a fifth of what one wrong pixel costs.
IMPROVEMENT, LEAST, PATIENCE, MOST_STEPS = 0.02, 3e-6, 60, 600
# The loss is waited for only now and then.
_LOOK_EVERY = 5

Array = npt.NDArray[np.float32]


class Modeller:
    """Lets a `Sculptor` of one view follow a target that changes at any time. To be used in one thread, like the sculptor.

    It begins at rest: a mesh matches its own shadow.

    Args:
        sculptor: with one view.
    """

    def __init__(self, sculptor: Sculptor) -> None:
        if len(sculptor.views) != 1:
            raise ShadowmapError(f"a sculptor of {len(sculptor.views)} views: one is needed to paint on.")
        self.sculptor = sculptor
        self.moving = False
        self.loss = 0.0
        self._steps = self._best_at = 0
        self._best = np.inf

    def set_target(self, image: npt.ArrayLike) -> None:
        """Another visibility image (H, W). Raises ShadowmapError, and goes on as before, where it cannot be used."""
        self.sculptor.set_target(0, image)
        self.wake()

    def reset(self, vertices: npt.ArrayLike | None = None) -> None:
        """Back to the first mesh, or to (V, 3) vertices; the target stays."""
        self.sculptor.reset(vertices)
        self.wake()

    def wake(self) -> None:
        """Go on, even though nothing has got better lately."""
        if not self.moving:
            # What gradients used to be says nothing about those of the next change.
            self.sculptor.calm()
        self.moving = True
        self._steps = self._best_at = 0
        self._best = np.inf

    def step(self) -> bool:
        """One step, unless it rests. Returns whether there was one.

        Raises ShadowmapError when the mesh has been lost to numbers that are not finite.
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
        self.loss = float(loss[0])
        if not np.isfinite(self.loss):
            raise ShadowmapError("the mesh has been lost: its vertices are not finite any more.")
        if self.loss < min((1 - IMPROVEMENT) * self._best, self._best - LEAST):
            self._best, self._best_at = self.loss, self._steps
        self.moving = self._steps - self._best_at < PATIENCE and self._steps < MOST_STEPS

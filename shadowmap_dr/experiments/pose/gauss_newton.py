"""Fit of a pose by Levenberg and Marquardt's method, from coarse images to fine ones."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...fitting.gains import Gain
from ...fitting.levenberg_marquardt import Limits, minimise
from ...fitting.losses import Loss
from ...fitting.motion_parameters import ShapeMotion
from ...fitting.objective import Point
from ...fitting.stages import make_stages, qualities
from ...fitting.targets import make_target
from ...fitting.vary import Vary
from ...rendering.receivers.checks import real_array
from ...rendering.renderer import Renderer

Array = npt.NDArray[np.float64]

# Longest change of a number in a step: radians, or scene units. Most steps of a stage.
_LONGEST, _STEPS = 0.3, 6
# Samples along a side of coarse images: with fewer, they miss parts of thin objects, and starts end elsewhere.
_SAMPLES = 128


class GaussNewtonPose:
    """Fit of a rotation about y (radians) and an offset in x and y: a `Method` of the optimisation loop, as `PoseFit`.

    A step is one of Levenberg and Marquardt's method, or goes to the next, finer images. After the last stage steps change
    nothing.

    Args:
        renderer: of the scene with the object in its target pose.
        shape: name of the object.
        reference: (H, W, 3) linear image.
        spp: samples per pixel of the last stage.
        shift_z: offset in z that the object has in the scene; the axis of rotation has it, too.
        settings: further entries for `describe`.
    """

    def __init__(
        self,
        renderer: Renderer,
        shape: str,
        reference: npt.ArrayLike,
        *,
        spp: int = 1,
        shift_z: float = 0.0,
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        image = real_array("reference", reference)
        if image.ndim != 3 or not np.isfinite(image).all():
            raise ShadowmapError(f"a reference of shape {image.shape}: give finite values in the shape (H, W, C).")
        entry = Vary(shape, "pose")
        motion = ShapeMotion(entry, 1.0, ("ry", "tx", "ty"), (shape,), np.array([0, 0, shift_z]))
        levels = qualities(max(image.shape[:2]), spp, renderer.settings.shadow.resolution, _SAMPLES)
        free, target = np.full(3, np.inf), make_target(np.maximum(image, 0))
        self._stages = make_stages(renderer, [motion], [], [target], [Gain()], free, Loss("l2"), levels)
        self._limits = Limits(-free, free, _LONGEST, _STEPS, improvement=1e-2, shortest=1e-4)
        self._settings = dict(settings or {})
        self._x, self._stage = np.zeros(3), 0
        self._points: Iterator[Point] | None = None
        self._point = self._stages[0].objective.at(self._x)

    def reset(self, start: npt.ArrayLike) -> None:
        """Start from (rotation in radians, x, y)."""
        self.load_state({"parameters": real_array("start", start), "stage": np.zeros(1)})

    def step(self) -> float:
        """Take one step. Returns the loss before it."""
        while self._stage < len(self._stages):
            if self._points is None:
                objective = self._stages[self._stage].objective
                self._point = objective.at(self._x)
                self._points = minimise(objective.at, self._point, self._limits)
            before = self._point
            better = next(self._points, None)
            if better is not None:
                self._point, self._x = better, better.x
                return float(before.cost)
            self._stage, self._points = self._stage + 1, None
        return float(self._point.cost)

    def parameters(self) -> Array:
        """Current parameters (3,): rotation in radians, x, y."""
        return self._x.copy()

    def render(self, parameters: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """Linear image (H, W, 3) at the given parameters."""
        return self._stages[-1].objective.views[0].image(real_array("parameters", parameters).astype(np.float64)).copy()

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Parameters (3,), and the stage (1,)."""
        return {"parameters": self._x, "stage": np.array([self._stage])}

    def load_state(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Continue from a result of `state`: from the beginning of its stage."""
        self._x = np.array(state["parameters"], np.float64).ravel()
        if self._x.shape != (3,):
            raise ShadowmapError(f"a pose of {self._x.size} numbers: give rotation (radians), x and y.")
        self._stage = int(state["stage"][0])
        self._points = None
        self._point = self._stages[min(self._stage, len(self._stages) - 1)].objective.at(self._x)

    def describe(self) -> dict[str, Any]:
        """Settings for the record."""
        return {**self._settings, "optimizer": "Levenberg-Marquardt", "stages": [stage.name for stage in self._stages]}

"""Losses of residuals, and their weights in iteratively reweighted least squares."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError, did_you_mean, quoted

Image = npt.NDArray[np.float32]
LossKind = Literal["huber", "l2", "l1"]
_KINDS = get_args(LossKind)

# Largest delta: products with residuals are numbers in single precision.
_MOST_DELTA = 1e12
# Residuals below this share of the picture's brightness count as squares in the loss l1, which has no second derivative.
_SMALL = 0.005


@dataclass(frozen=True)
class Loss:
    """A loss of residuals that are shares of a picture's brightness.

    Attributes:
        kind: ``huber``: squares up to ``delta``, absolute values above; ``l2``: squares; ``l1``: absolute values.
        delta: of the Huber loss.
    """

    kind: LossKind = "huber"
    delta: float = 0.1

    def __post_init__(self) -> None:
        if self.kind not in _KINDS:
            raise ShadowmapError(f"loss is {quoted(self.kind)}: choose huber, l2 or l1.{did_you_mean(self.kind, _KINDS)}")
        if not 0 < self.delta <= _MOST_DELTA:
            raise ShadowmapError(f"delta of the loss is {quoted(self.delta)}: give a positive number up to {_MOST_DELTA:g}.")

    @property
    def limit(self) -> float:
        """Residual above which the loss grows like the absolute value."""
        return {"huber": self.delta, "l2": np.inf, "l1": _SMALL}[self.kind]

    def value(self, residual: Image) -> Image:
        """Loss of each residual."""
        size = np.abs(residual)
        if self.kind == "l2":
            return np.asarray(0.5 * size * size, np.float32)
        inner = np.minimum(size, self.limit)
        return np.asarray(0.5 * inner * inner + self.limit * (size - inner), np.float32)

    def weight(self, residual: Image) -> Image:
        """Weight of each residual with which squares have the loss's derivative."""
        if self.kind == "l2":
            return np.ones_like(residual)
        return np.asarray(self.limit / np.maximum(np.abs(residual), self.limit), np.float32)

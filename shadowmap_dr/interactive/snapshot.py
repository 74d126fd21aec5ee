"""Records of a session that other threads may read: its status, and the mesh at one moment."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt

from .start_mesh import StartMesh

Phase = Literal["starting", "moving", "resting", "failed", "closed"]
Array = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Status:
    """Status of the optimiser. The message is the reason of a failure."""

    phase: Phase
    message: str = ""


@dataclass(frozen=True)
class Snapshot:
    """The mesh at one moment. Do not write into its arrays.

    Attributes:
        number: counts snapshots from 1 on.
        steps: number of steps so far.
        target: version of the target of the last step.
        loss: before the last step.
        speed: steps per second during the last second, 0 at rest.
        vertices: (V, 3), world space.
        shadow: (H, W), visibility, 0 (dark) to 255 (lit).
        faces: (F, 3).
        start: mesh that the modelling has begun with, None if the modeller does not know it.
    """

    number: int
    steps: int
    target: int
    loss: float
    speed: float
    vertices: Array
    shadow: npt.NDArray[np.uint8]
    faces: npt.NDArray[np.uint32] = field(default_factory=lambda: np.zeros((0, 3), np.uint32))
    start: StartMesh | None = None

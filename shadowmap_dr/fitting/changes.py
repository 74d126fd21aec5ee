"""Changes to a scene, by the names that a scene file knows."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Changes:
    """Stand-in until the merge."""

    values: dict[str, Array] = field(default_factory=dict)
    transforms: dict[str, Array] = field(default_factory=dict)
    vertices: dict[str, Array] = field(default_factory=dict)

"""Parametrisations of users: numbers, and a function that changes the scene by them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError
from ..jit.types import Float
from ..rendering.renderer import Renderer
from .parameters import Scale
from .scene_change import SceneChange
from .vary import Vary

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Own:
    """An entry of the list of things that vary, with a function instead of a kind.

    Attributes:
        name: for reports.
        function: gets the numbers (a list of Float of width 1, attached) and a
            :class:`~shadowmap_dr.fitting.SceneChange`. It moves shapes (``change.move(["lid"], matrix)``), replaces
            records (``change.lights[name] = dataclasses.replace(change.light(name), ...)``, ``change.cameras``) or sets numbers
            of Mitsuba's parameters (``change.values[key] = [number, ...]``). It is recorded: it may use Dr.Jit's functions and
            constants, no arrays of its own.
        start: the numbers at which the scene is as it was given, (n,).
        spread: half ranges of starts about these, (n,) or one for all. They also are the units in which steps are measured.
        low, high: bounds.
        labels, units: of the numbers, for reports.
    """

    name: str
    function: Callable[[list[Float], SceneChange], None]
    start: Sequence[float]
    spread: float | Sequence[float]
    low: float = -np.inf
    high: float = np.inf
    labels: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    kind: str = "own"

    def __post_init__(self) -> None:
        count, spread = len(self.start), np.asarray(self.spread, np.float64)
        if not count or not np.isfinite(self.start).all() or not ((spread > 0) & np.isfinite(spread)).all():
            raise ShadowmapError(f"vary {self.name}: give finite numbers to start from, and positive ones as spread.")
        for name, usual in (("labels", tuple(f"number {k + 1}" for k in range(count))), ("units", ("",) * count)):
            given = getattr(self, name) or usual
            if len(given) != count:
                raise ShadowmapError(f"vary {self.name}: {len(given)} {name} for {count} numbers; give one for each.")
            object.__setattr__(self, name, tuple(given))

    @property
    def label(self) -> str:
        """The name."""
        return self.name

    @property
    def vary(self) -> Vary:
        """The entry as others have it."""
        return Vary(self.name)

    @property
    def natural(self) -> tuple[float, float]:
        return self.low, self.high

    @property
    def scale(self) -> Scale:
        start = np.array(self.start, np.float64)
        return Scale(start, np.broadcast_to(np.asarray(self.spread, np.float64), start.shape))

    @property
    def usual(self) -> Array:
        return np.ones(len(self.start))

    def put(self, numbers: Sequence[Float], change: SceneChange) -> None:
        scale = self.scale
        shown = [float(a) + float(b) * x for a, b, x in zip(scale.offset, scale.factor, numbers, strict=True)]
        self.function(shown, change)

    def arrays(self, renderer: Renderer, change: SceneChange) -> dict[str, Array]:
        return {}

    def plain(self) -> dict[str, Any]:
        """The fields that a file can hold. It cannot hold the function."""
        return {"name": self.name, "kind": self.kind}

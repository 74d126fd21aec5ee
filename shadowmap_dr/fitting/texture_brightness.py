"""Common factors of textures' values, which are fitted with the other numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import numpy as np
import numpy.typing as npt

from ..jit.types import Float
from ..rendering.renderer import Renderer
from .arrays import TextureValues
from .parameters import Scale
from .scene_change import SceneChange
from .vary import Vary

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TextureBrightness:
    """The factor of all values of a texture.

    A bright texture in a dark exposure looks like a dark one in a bright exposure. Steps of the one and then of the other hardly
    move along this valley; a step of both does.
    """

    texture: TextureValues
    natural: tuple[float, float] = (0.1, 10.0)
    labels: tuple[str, ...] = ("brightness",)
    units: tuple[str, ...] = ("times",)
    kind: str = "texture brightness"

    @property
    def vary(self) -> Vary:
        return replace(self.texture.vary, low=None, high=None, prior=None, spread=None)

    @property
    def scale(self) -> Scale:
        return Scale(np.ones(1), np.ones(1), logarithmic=True)

    @property
    def usual(self) -> Array:
        return np.zeros(1)

    def put(self, numbers: Sequence[Float], change: SceneChange) -> None:
        change.factors[self.texture.key] = dr.exp(numbers[0])

    def arrays(self, renderer: Renderer, change: SceneChange) -> dict[str, Array]:
        return {}

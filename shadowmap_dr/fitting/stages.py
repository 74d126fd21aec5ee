"""Stages of a fit, from coarse to fine: images grow, and the filters of shadow maps narrow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..rendering.renderer import Renderer
from ..scene.sensor import ImageSize
from .arrays import ArrayParameter
from .comparison import Observation
from .gains import Gain
from .losses import Loss
from .objective import Objective
from .own_losses import OwnFunction
from .parameters import Parameter
from .targets import Target
from .views import Quality, View

Array = npt.NDArray[np.float64]

# Sizes of the first stage: pixels along the longer side, and texels of a map.
_COARSEST, _FEWEST_TEXELS = 12, 64


@dataclass(frozen=True)
class Stage:
    """A stage: its quality, and the loss at it. ``name`` for people: the pixels along the longer side."""

    quality: Quality
    objective: Objective

    @property
    def name(self) -> str:
        return f"{self.quality.side} px"


def qualities(side: int, spp: int, texels: int, samples: int = 64) -> list[Quality]:
    """Qualities of the stages, coarse first; the last one is as given. ``samples``: at least so many along the longer side."""
    sides = [side]
    while sides[0] / 2 >= _COARSEST:
        sides.insert(0, sides[0] // 2)
    return [
        Quality(
            own,
            max(spp, math.ceil(samples / own) ** 2),
            max(min(texels, _FEWEST_TEXELS), round(texels * own / side)),
            *_light_quality(side / own),
        )
        for own in sides
    ]


def _light_quality(coarseness: float) -> tuple[int, int]:
    """(samples of an area light, texels of their maps) of a stage with so many times fewer pixels along a side."""
    return (16, 64) if coarseness < 1.5 else (8, 64) if coarseness < 6 else (4, 32)


def make_stages(
    renderer: Renderer,
    parameters: Sequence[Parameter],
    arrays: Sequence[ArrayParameter],
    targets: Sequence[Target],
    gains: Sequence[Gain],
    prior: Array,
    loss: Loss,
    levels: Sequence[Quality],
    residuals: OwnFunction | None = None,
    own_loss: OwnFunction | None = None,
) -> list[Stage]:
    """The stages of a fit, coarse first. Arguments as of :class:`Objective`, for pictures at their own sizes."""
    stages = []
    for quality in levels:
        views, observations = [], []
        for target, gain in zip(targets, gains, strict=True):
            size = size_of(target, quality.side)
            views.append(View(renderer, parameters, arrays, target.sensor, size, quality))
            small = target.resized(size.width, size.height)
            observations.append(Observation(small.image, small.weight, gain))
        stages.append(Stage(quality, Objective(views, observations, prior, loss, residuals, own_loss)))
    return stages


def size_of(target: Target, side: int) -> ImageSize:
    """Size of a picture with ``side`` pixels along the longer side, at most its own."""
    share = min(1.0, side / max(target.width, target.height))
    return ImageSize(max(1, round(target.width * share)), max(1, round(target.height * share)))

"""Starts of a fit, and the choice of those that go on to the next stage."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from .objective import Objective
from .parameters import Parameter

Array = npt.NDArray[np.float64]

# Starts that go on after the first, second, ... stage: shares of all, and fewest.
_SHARES, _FEWEST = (0.5, 0.25), (4, 2)


def half_ranges(parameters: Sequence[Parameter]) -> Array:
    """Half ranges (n,) of starts, in the fit's numbers."""
    found = []
    for parameter in parameters:
        spread, scale, count = parameter.vary.spread, parameter.scale, len(parameter.labels)
        if spread is None:
            found.append(parameter.usual)
        elif scale.logarithmic:
            found.append(np.full(count, abs(np.log(spread))))
        else:
            found.append(np.broadcast_to(spread / scale.factor, count))
    return np.concatenate([np.zeros(0), *found])


def draw(ranges: Array, low: Array, high: Array, count: int, seed: int) -> list[Array]:
    """Starts (n,) of the scene's numbers: the scene as it is, and others uniform in the ranges and within the bounds."""
    generator = np.random.default_rng(seed)
    first = np.zeros(len(ranges))
    others = [np.clip(generator.uniform(-ranges, ranges), low, high) for _ in range(count - 1)] if len(ranges) else []
    return [np.clip(first, low, high), *others]


def with_gains(x: Array, objective: Objective) -> Array:
    """The numbers x of a scene, followed by the gains with which its images are as bright as the pictures."""
    full = np.concatenate([x, np.zeros(objective.count - len(x))])
    for number, seen in enumerate(objective.observations):
        gain, own = seen.gain, objective.gains[number]
        if not gain.colours:
            continue
        image = objective.recorded(number, objective.views[number].image(full), full)
        weight = seen.weight[..., None].astype(np.float64)
        ours, theirs = ((weight * picture).sum((0, 1)) for picture in (image, seen.image))
        if gain.colours == 1:
            ours, theirs = ours.sum(keepdims=True), theirs.sum(keepdims=True)
        full[own.start : own.start + gain.colours] = np.log(np.maximum(theirs, 1e-6) / np.maximum(ours, 1e-6))
    return full


def going_on(costs: Sequence[float], stage: int) -> list[int]:
    """Indices of the starts, best first, that go on after a stage (from 0)."""
    order = np.argsort(costs, kind="stable").tolist()
    share, fewest = _SHARES[min(stage, len(_SHARES) - 1)], _FEWEST[min(stage, len(_FEWEST) - 1)]
    return order[: max(fewest, round(share * len(order)))]

"""Starts of a fit, and the choice of those that go on to the next stage."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from .objective import Objective
from .parameters import Parameter

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

#: Largest factor in the ranges of values that stay positive: from its inverse to itself.
LARGEST_FACTOR = 1e6
# Candidates for each start.
_TRIED = 8
# Draws of a candidate at most.
_DRAWS = 20
# Starts that go on: to stages of half of the last one's pixels along a side, of a quarter, ...
_GOING_ON = (1, 2, 4, 8, 16)


def half_ranges(parameters: Sequence[Parameter], growth: float = 1.0) -> Array:
    """Half ranges (n,) of starts, in the fit's numbers; ``growth`` times as wide as those of the first ones."""
    found = []
    for parameter in parameters:
        spread, scale, count = parameter.vary.spread, parameter.scale, len(parameter.labels)
        if spread is None:
            half = parameter.usual
        elif scale.logarithmic:
            half = np.full(count, abs(np.log(spread)))
        else:
            half = np.broadcast_to(spread / scale.factor, count)
        found.append(np.minimum(half * growth, np.log(LARGEST_FACTOR)) if scale.logarithmic else half * growth)
    return np.concatenate([np.zeros(0), *found])


def draw(ranges: Array, low: Array, high: Array, count: int, seed: int | tuple[int, int], *, scene: bool = True) -> list[Array]:
    """Candidates (n,) of the scene's numbers: ``_TRIED`` for each of ``count`` starts, uniform in the ranges, within the bounds.

    The first is the scene as it is, if ``scene``.
    """
    generator = np.random.default_rng(seed)
    if not ranges.any():
        return [np.clip(np.zeros(len(ranges)), low, high)]
    others = [generator.uniform(-ranges, ranges) for _ in range(1 + (count - 1) * _TRIED)]
    if scene:
        others[0] = np.zeros(len(ranges))
    return [np.clip(x, low, high) for x in others]


def redraw(
    best: Array,
    groups: Sequence[Indices],
    ranges: Array,
    low: Array,
    high: Array,
    count: int,
    seed: tuple[int, ...],
    apart: float = 0.0,
) -> list[Array]:
    """``count`` candidates that differ from the best numbers (n,) in one group each, drawn as by :func:`draw`.

    Often all but one of several objects are right, or the place of an object that is turned wrongly.

    Args:
        apart: least distance from the best numbers, in ranges.
    """
    generator, found = np.random.default_rng(seed), []
    for k in range(count if groups else 0):
        x, own = best.copy(), groups[k % len(groups)]
        for _ in range(_DRAWS):
            x[own] = generator.uniform(-ranges[own], ranges[own])
            if np.linalg.norm((x - best)[own] / np.maximum(ranges[own], 1e-30)) >= apart:
                break
        found.append(np.clip(x, low, high))
    return found


def groups_of(parameters: Sequence[Parameter]) -> tuple[list[Indices], list[Indices]]:
    """(numbers of each entry, numbers of each entry that turn an object): :func:`redraw` draws them together."""
    every, turns, first = list[Indices](), list[Indices](), 0
    for parameter in parameters:
        own = np.arange(first, first + len(parameter.labels))
        turn = own[[label.startswith("rotation") for label in parameter.labels]]
        every.append(own)
        turns += [turn] if len(turn) else []
        first += len(own)
    return every, turns


def chosen(candidates: Sequence[Array], objective: Objective, count: int, *, keep: bool) -> list[Array]:
    """The best ``count`` of some candidates with gains, best first; if ``keep``, the first candidate is always one, the first."""
    kept = [with_gains(x, objective) for x in candidates[: int(keep)]]
    others, costs = list[Array](), list[float]()
    for x in candidates[len(kept) :]:
        others.append(with_gains(x, objective))
        costs.append(objective.at(others[-1]).cost)  # of the image that gave the gains
    return kept + [others[k] for k in np.argsort(costs, kind="stable")[: count - len(kept)].tolist()]


def with_gains(x: Array, objective: Objective) -> Array:
    """The numbers x of a scene, followed by the gains with which its images are as bright as the pictures."""
    full = np.concatenate([x, np.zeros(objective.count - len(x))])
    for number, seen in enumerate(objective.observations):
        gain, own = seen.gain, objective.gains[number]
        if not gain.colours:
            continue
        image = objective.recorded(number, objective.images(full)[number], full)
        weight = seen.weight[..., None].astype(np.float64)
        ours, theirs = ((weight * picture).sum((0, 1)) for picture in (image, seen.image))
        if gain.colours == 1:
            ours, theirs = ours.sum(keepdims=True), theirs.sum(keepdims=True)
        full[own.start : own.start + gain.colours] = np.log(np.maximum(theirs, 1e-6) / np.maximum(ours, 1e-6))
    return full


def going_on(costs: Sequence[float], left: int) -> list[int]:
    """Indices of the starts, best first, that go on to a stage which ``left`` others follow."""
    order: list[int] = np.argsort(costs, kind="stable").tolist()
    return order[: _GOING_ON[min(left, len(_GOING_ON) - 1)]]

"""Judgement of a fit: whether the scene explains the pictures, and in words what they do not determine."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from .objective import Objective, Point
from .uncertainty import Uncertainty, not_told_apart

Array = npt.NDArray[np.float64]

#: Largest error, as a share of the brightness, with which a fit counts as found.
EXPLAINED = 0.12


def judge(
    point: Point, objective: Objective, spread: Uncertainty, names: Sequence[str], ends: Sequence[Array], costs: Sequence[float]
) -> tuple[bool, list[str]]:
    """(True if the scene explains the pictures, sentences).

    Args:
        point: the best point.
        objective: of the last stage.
        spread: its uncertainty.
        names: of all numbers.
        ends: numbers at which the starts of the last stage ended, best first, with their ``costs``.
    """
    words: list[str] = []
    found = point.error <= EXPLAINED
    if not found:
        words.append(
            f"Not found: the images differ by {100 * point.error:.0f} % of the picture's brightness. Try more starts, a "
            "scene that is nearer to the picture, or let more vary; mask what the scene does not have."
        )
    idle = [name for name, none in zip(names, spread.idle, strict=True) if none]
    words += [f"{name} moves nothing in the pictures." for name in idle]
    for a, b in not_told_apart(spread):
        words.append(f"{names[a]} and {names[b]} cannot be told apart by the pictures.")
    loose = [n for n, half, none in zip(names, spread.half_widths, spread.idle, strict=True) if np.isinf(half) and not none]
    words += [f"{name} is not determined by the pictures." for name in loose]
    return found, words

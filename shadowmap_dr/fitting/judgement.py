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
    pairs = not_told_apart(spread)
    words += [f"{names[a]} and {names[b]} cannot be told apart by the pictures." for a, b in pairs]
    loose = np.isinf(spread.half_widths) & ~spread.idle
    loose[[number for pair in pairs for number in pair]] = False  # the sentence above says it
    words += [f"{name} is not determined by the pictures." for name, it_is in zip(names, loose, strict=True) if it_is]
    return found, words

"""Judgement of a fit: whether the scene explains the pictures, and in words the numbers that they do not determine."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .comparison import Colours
from .objective import Objective, Point
from .own_losses import is_image
from .uncertainty import Uncertainty, not_told_apart

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.float32]

#: Largest share of unexplained edges with which a fit counts as found, and that of corrected images of few numbers.
EXPLAINED, EXPLAINED_CORRECTED = 0.16, 0.04
# Pixels along the longer side of the images whose edges are compared, at most: noise and blurred outlines count little there.
_SIDE = 56
# Mean square of differences between neighbours below which they are alike, as a share of that of unrelated neighbours.
_SMOOTH = 0.5
# Largest share of the edges that noise may explain, multiple of its deviation that residuals exceed where they matter, and
# multiple of its median variance that it has at most.
_NOISY, _ABOVE, _UNEVEN = 0.5, 2.5, 4.0
# Largest variance of a block of one colour, over its mean square, and least share of the others by which noise is measured.
_CONSTANT, _FOREGROUND = 1e-6, 0.25
# Pixels matter where a change of a number by the first moves them by more than the second, a share of the brightness; and
# where the residual is larger. Numbers that move fewer blocks of pixels are not judged on their own, nor are fewer
# residuals where nothing moves.
_CHANGE, _VISIBLE, _FEW = 0.05, 0.03, 8
# Distance from a bound, in the fit's own numbers, that is none.
_AT_BOUND = 1e-4
# Largest share of the edges that one number moves, as a multiple of that of the whole.
_OF_NUMBER = 2.0


@dataclass(frozen=True)
class Unexplained:
    """Shares of the pictures' edges that the images do not have, or have elsewhere: 0 for equal images, 1 for unrelated ones.

    Attributes:
        whole: of all edges that matter.
        numbers: (n,) of those that each of the scene's numbers moves; 0 for numbers that move few.
        few: (n,) True for the numbers that move few.
    """

    whole: float
    numbers: Array
    few: npt.NDArray[np.bool_]

    @property
    def largest(self) -> float:
        """The largest share. A small object that is turned wrongly is hardly a part of the whole."""
        return max(self.whole, float(self.numbers.max(initial=0)))

    def is_small(self, limit: float) -> bool:
        """True if the whole is at most a limit, and no number is :meth:`wrong`."""
        return self.whole <= limit and not self.wrong(limit).any()

    def wrong(self, limit: float) -> npt.NDArray[np.bool_]:
        """True (n,) for the numbers whose share is beyond the limit of fewer edges, among which noise weighs more."""
        return np.asarray(self.numbers > _OF_NUMBER * limit)


def largest_share(objective: Objective) -> float:
    """Largest share of unexplained edges with which a fit counts as found."""
    # Textures and vertices take a given number of steps, and residuals of users see other things.
    plain = not objective.has_own_residuals and not objective.views[0].values
    return EXPLAINED_CORRECTED if objective.is_corrected and plain else EXPLAINED


def sentences(
    found: bool, shares: Unexplained, error: float, spread: Uncertainty, names: Sequence[str], *, own: bool = False
) -> list[str]:
    """Sentences about a fit: whether the scene explains the pictures, and the numbers that they do not determine.

    Args:
        found: true if it does.
        shares: of unexplained edges.
        error: of the best point.
        spread: its uncertainty.
        names: of all numbers.
        own: true if share and error are those of a user's residuals.
    """
    words: list[str] = []
    if not found:
        seen, where = "what your residuals see" if own else "the edges that matter", ""
        if shares.whole < shares.largest:
            where = f", where {names[int(np.argmax(shares.numbers))]} moves it,"
        words.append(
            f"Not found: {100 * shares.largest:.0f} % of {seen} in the picture{where} "
            f"{'is' if own else 'are'} not where the scene has {'it' if own else 'them'}, and the images differ by "
            f"{100 * error:.0f} % of {'it' if own else 'the brightness'}. Try more starts, a scene that is nearer to the "
            "picture, or let more vary; mask what the scene does not have."
        )
    idle = [name for name, none in zip(names, spread.idle, strict=True) if none]
    words += [f"{name} moves nothing in the pictures." for name in idle]
    pairs = not_told_apart(spread)
    words += [f"{names[a]} and {names[b]} cannot be told apart by the pictures." for a, b in pairs]
    loose = np.isinf(spread.half_widths) & ~spread.idle
    loose[[number for pair in pairs for number in pair]] = False  # the sentence above says it
    words += [f"{name} is not determined by the pictures." for name, it_is in zip(names, loose, strict=True) if it_is]
    return words


def bound_sentences(x: Array, low: Array, high: Array, names: Sequence[str], given: npt.NDArray[np.bool_]) -> list[str]:
    """Sentences about numbers that end at bounds of the user's. ``given``: (n, 2) True for lower and upper bounds that are."""
    close = np.stack([x <= low + _AT_BOUND, x >= high - _AT_BOUND], 1) & given
    ends = ("min: the pictures ask for less", "max: the pictures ask for more")
    return [f"{names[k]} is at its {ends[side]}." for k, side in np.argwhere(close).tolist()]


def unexplained(point: Point, objective: Objective) -> Unexplained:
    """Shares of the pictures' edges that the images do not have, or have elsewhere.

    Edges are differences between neighbouring pixels. They count where the fitted numbers, or errors, change the images. Smooth
    differences, such as light that bounces, hardly count. Residuals of users that are like edges, or no images at all, are
    taken as they are.
    """
    count = objective.views[0].count
    missing, total, blocks = np.zeros(1 + count), np.zeros(1 + count), np.zeros(1 + count)
    for columns, image, residual, compared in zip(
        point.columns(), point.recorded, point.residuals, objective.comparisons, strict=True
    ):
        weight = np.broadcast_to(compared.weight, (*residual.shape[:2], 1))[..., 0]
        arrays = *compared.contents(image), residual, weight, np.asarray(weight > 0, np.float32)
        times = max(2, round(max(weight.shape) / _SIDE)) if is_image(residual.shape) else 1
        noise = _noise(residual, arrays[1], weight, times)
        ours, theirs, left, weight, whole = (_reduced(one, times) for one in arrays)
        pairs = isinstance(compared, Colours) or is_image(residual.shape) and _is_smooth(theirs)
        moved = [_reduced(np.abs(column).reshape(residual.shape).max(2) * _CHANGE, times) > _VISIBLE for column in columns]
        wrong = _beside_others(np.abs(left).mean(2) > np.maximum(_VISIBLE, _ABOVE * np.sqrt(noise[..., 0])))
        for k, matters in enumerate([np.any([*moved, wrong], axis=0), *moved[:count]]):
            # Pixels that do not count are black: blocks with one count for nothing.
            counted = np.asarray(weight * (whole == 1) * matters, np.float32)
            blocks[k] += np.count_nonzero(counted)
            for of_image, of_picture, of_residual, both, of_noise in _edges(pairs, ours, theirs, left, counted[..., None], noise):
                found = float((both * of_residual**2).sum(dtype=np.float64))
                expected = of_residual.shape[2] * float((both * of_noise).sum(dtype=np.float64))
                there = float((both * (of_image**2 + of_picture**2)).sum(dtype=np.float64))
                missing[k] += max(found - min(expected, _NOISY * there), 0.0)
                total[k] += there
    shares = np.where(total > 0, missing / np.where(total > 0, total, 1), 0)
    few = blocks[1:] < _FEW
    return Unexplained(float(shares[0]), np.where(few, 0, shares[1:]), few)


def _noise(residual: Image, picture: Image, weight: Image, times: int) -> Image:
    """Variance (h, w, 1) of blocks' means that noise of single pixels makes.

    It differs from place to place, but edges that are elsewhere, which vary in few blocks alone, are no noise. Of a path-traced
    picture, nothing but the background is without noise: what is constant there tells nothing of the rest.
    """
    if times < 2:
        return np.zeros((*weight.shape, 1), np.float32)
    inside = _variances(residual, times) / (times**2 - 1)
    counts = _reduced(np.asarray(weight > 0, np.float32), times) == 1
    if picture.shape[:2] == residual.shape[:2]:
        varies = counts & (_variances(picture, times) > _CONSTANT * np.square(_reduced(picture, times)).mean(2))
        counts = varies if varies.sum() >= _FOREGROUND * counts.sum() else counts
    most = max(_UNEVEN * float(np.median(inside[counts])), 0.0) if counts.any() else 0.0
    return np.asarray(np.clip(inside, 0, most)[..., None], np.float32)


def _beside_others(chosen: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Chosen blocks (h, w) with a chosen one beside them; none if they are few. Noise exceeds its deviation here and there, while
    edges that are elsewhere lie along lines."""
    wide = np.pad(chosen, 1)
    found = np.asarray(chosen & (wide[:-2, 1:-1] | wide[2:, 1:-1] | wide[1:-1, :-2] | wide[1:-1, 2:]))
    return found if found.sum() >= _FEW else np.zeros_like(found)


def _variances(image: Image, times: int) -> Image:
    """Variances (h, w) within blocks of pixels, means over the channels."""
    return np.asarray((_reduced(np.square(image), times) - np.square(_reduced(image, times))).mean(2), np.float32)


def _is_smooth(image: Image) -> bool:
    """True if neighbours are mostly alike: colours, and not edges of colours."""
    square = float(np.square(image, dtype=np.float64).sum())
    steps = [float(np.square(np.diff(image, axis=axis), dtype=np.float64).sum()) for axis in (0, 1)]
    return sum(steps) < _SMOOTH * 4 * square


def _edges(pairs: bool, *arrays: Image) -> Iterator[tuple[Image, ...]]:
    """Differences between neighbours along each axis, if ``pairs``; of the weights, the last but one, the smaller ones, and of
    the variances of noise, the last one, the sums."""
    if not pairs:
        yield arrays
        return
    *images, weight, noise = arrays
    for axis in (0, 1):
        (first, second), (one, other) = (
            (np.take(array, range(1, array.shape[axis]), axis), _without_last(array, axis)) for array in (weight, noise)
        )
        yield *(np.diff(image, axis=axis) for image in images), np.minimum(first, second), one + other


def _reduced(image: Image, times: int) -> Image:
    """Means of blocks of pixels; a rest at the border is left out."""
    rows, columns = image.shape[0] // times, image.shape[1] // times
    blocks = image[: rows * times, : columns * times].reshape(rows, times, columns, times, *image.shape[2:])
    return np.asarray(blocks.mean((1, 3)), np.float32)


def _without_last(array: Image, axis: int) -> Image:
    return np.take(array, range(array.shape[axis] - 1), axis)

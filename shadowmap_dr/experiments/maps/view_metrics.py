"""Faults of an image under the sun: light in shadow, dark in light, shadows that leave their casters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .metrics import Image

Mask = npt.NDArray[np.bool_]

# Shares of the brightness (its 95th percentile): surfaces above the first are in the sun's direction, pixels within the second
# of black are dark, and within the second of the unshadowed image they are lit.
_SHONE_ON, _SAME = 0.2, 0.02
# Pixels between the borders of dark areas and their inside; least number of pixels of a mean, and of edges.
_INSIDE, _LEAST, _LEAST_EDGES = 2, 30, 10
#: Largest distance of a shadow from its caster, pixels. One that is not found counts as much.
FARTHEST = 24


@dataclass(frozen=True)
class Truth:
    """Path-traced light and shadow of a view, all (H, W).

    Attributes:
        visibility: light over unshadowed light, 0 to 1; 0 outside of ``shone_on``.
        unshadowed: the renderer's own image without shadows, largest channel.
        shone_on: surfaces that face the sun.
        dark, lit: pixels that are fully dark, and fully lit.
    """

    visibility: Image
    unshadowed: Image
    shone_on: Mask
    dark: Mask
    lit: Mask

    @classmethod
    def of(cls, traced: Image, bare: Image) -> Truth:
        """From a path-traced image and our unshadowed one, (H, W, 3), linear."""
        white = float(np.percentile(bare, 95))
        most = bare.max(-1)
        shone_on = most > _SHONE_ON * white
        dark = (traced.max(-1) < _SAME * white) & shone_on
        lit = (np.abs(traced - bare).max(-1) < _SAME * white) & shone_on
        visibility = np.where(shone_on, np.clip(traced.max(-1) / np.maximum(most, 1e-6), 0, 1), 0)
        return cls(visibility.astype(np.float32), most, shone_on, dark, lit)

    def share(self, image: Image) -> Image:
        """Visibility (H, W) of an image (H, W, 3): its light over the unshadowed light."""
        return image.max(-1) / np.maximum(self.unshadowed, 1e-6)


def view_metrics(image: Image, truth: Truth) -> dict[str, float]:
    """Errors of an image (H, W, 3). Not a number where there are too few pixels.

    ``light_in_shadow``: mean visibility where path tracing is dark; ``light_in_shadow_inside``: two pixels away from the borders
    of dark areas; ``dark_in_light``: mean of one minus the visibility where path tracing is lit; ``rmse``: root mean square of
    the visibility's error on surfaces that face the sun.
    """
    share = truth.share(image)
    error = np.clip(share, 0, 1) - truth.visibility
    return {
        "light_in_shadow": _mean(share, truth.dark),
        "light_in_shadow_inside": _mean(share, _inside(truth.dark)),
        "dark_in_light": _mean(1 - share, truth.lit),
        "rmse": float(np.sqrt(_mean(error**2, truth.shone_on))),
    }


def detachment(visibility: Image, truth: Truth, caster: Mask, along: tuple[int, int]) -> float:
    """Mean distance of a shadow from its caster's edge in pixels, beyond that of the path-traced shadow.

    Args:
        visibility: (H, W).
        truth: the path-traced light and shadow.
        caster: (H, W), pixels that show the caster.
        along: (column, row), steps from a caster to its shadow, whole pixels.

    Returns:
        The distance; not a number if path tracing shows no shadow beside the caster.
    """
    traced, found = _distances(truth.visibility, truth.shone_on, caster, along)
    ours, _ = _distances(visibility, truth.shone_on, caster, along)
    there = found & (traced < FARTHEST)
    return float((ours - traced)[there].mean()) if there.sum() >= _LEAST_EDGES else float("nan")


def _distances(visibility: Image, shone_on: Mask, caster: Mask, along: tuple[int, int]) -> tuple[npt.NDArray[np.int64], Mask]:
    """Lit pixels between the caster's edge and the first pixel below one half, for all edge pixels, and a mask of good ones.

    Steps end at surfaces that do not face the sun, and at the image's border.
    """
    height, width = caster.shape
    rows, columns = np.nonzero(caster)
    distance = np.full(len(rows), FARTHEST)
    walks = np.ones(len(rows), bool)
    good = np.ones(len(rows), bool)
    for step in range(1, FARTHEST + 1):
        r, c = rows + step * along[1], columns + step * along[0]
        inside = (r >= 0) & (r < height) & (c >= 0) & (c < width)
        r, c = np.clip(r, 0, height - 1), np.clip(c, 0, width - 1)
        if step == 1:  # the edge: its next pixel is none of the caster
            good &= ~caster[r, c]
        usable = inside & shone_on[r, c] & ~caster[r, c]
        dark = walks & usable & (visibility[r, c] < 0.5)
        distance[dark] = step - 1
        walks &= usable & ~dark
        good &= usable | (distance < FARTHEST)
    return distance, good


def _mean(values: Image, where: Mask) -> float:
    return float(values[where].mean()) if where.sum() >= _LEAST else float("nan")


def _inside(mask: Mask) -> Mask:
    for _ in range(_INSIDE):
        mask = mask & np.roll(mask, 1, 0) & np.roll(mask, -1, 0) & np.roll(mask, 1, 1) & np.roll(mask, -1, 1)
    return mask

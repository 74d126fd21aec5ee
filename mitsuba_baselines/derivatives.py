"""Derivative images by central differences of path-traced renderings, and the agreement of two derivative images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from shadowmap_dr.errors import ShadowmapError

from .reference import Reference, path_traced


@dataclass(frozen=True)
class Agreement:
    """Agreement of an automatic derivative image a with a reference f.

    Attributes:
        cosine: <a, f> / (|a| |f|), 1 for equal up to a factor.
        scale: <a, f> / <f, f>, the factor, 1 for equal images.
    """

    cosine: float
    scale: float


def agreement(automatic: np.ndarray, reference: np.ndarray, filter_footprint: float = 0.0) -> Agreement:
    """Compare two derivative images after a sum over colour channels and a blur.

    Args:
        automatic, reference: (H, W, C) arrays.
        filter_footprint: Width of the shadow filter in image pixels; the blur is a box of max(5, 2 x footprint) pixels,
            rounded up to an odd number; at the borders, of the pixels within the image.

    Raises:
        ShadowmapError: The shapes differ or the reference is all zero.
    """
    if automatic.shape != reference.shape or automatic.ndim != 3:
        raise ShadowmapError(f"derivative images of shapes {automatic.shape} and {reference.shape}: give two (H, W, C).")
    size = max(5, int(np.ceil(2 * filter_footprint)))
    size += 1 - size % 2
    a, f = (_box_blur(np.asarray(image, np.float64).sum(-1), size).ravel() for image in (automatic, reference))
    product, square = float(a @ f), float(f @ f)
    if square == 0:
        raise ShadowmapError("the reference derivative is zero everywhere: choose a parameter that changes the image.")
    return Agreement(product / max(float(np.sqrt((a @ a) * square)), 1e-300), product / square)


def central_difference(
    build: Callable[[float], mi.Scene],
    step: float,
    *,
    at: float = 0.0,
    spp: int = 4096,
    seed: int = 0,
    integrator: str | None = None,
) -> Reference:
    """(I(at + step) - I(at - step)) / (2 step) of path-traced renderings with the same seed.

    Args:
        build: Makes the scene for a parameter value.
        step: In units of the parameter; shadow boundaries of the two renderings should lie 0.5 to 1 pixel apart.
        at: Parameter value of the derivative.
        spp, seed, integrator: See `path_traced`.

    Returns:
        The derivative image, (H, W, C) float32, with `step`, `at` and the renderings' settings.
    """
    high, low = (path_traced(build(at + sign * step), spp=spp, seed=seed, integrator=integrator) for sign in (1, -1))
    settings = {key: value for key, value in high.settings.items() if key != "relative_standard_error"}
    settings.update(kind="central_difference", step=step, at=at)
    return Reference((high.image - low.image) / np.float32(2 * step), settings)


def _box_blur(image: np.ndarray, size: int) -> np.ndarray:
    """Mean over size x size pixels, over fewer at the borders."""
    half = size // 2

    def along(values: np.ndarray) -> np.ndarray:
        total = np.cumsum(np.concatenate([np.zeros((1, values.shape[1])), values]), axis=0)
        index = np.arange(values.shape[0])
        end, start = np.minimum(index + half + 1, values.shape[0]), np.maximum(index - half, 0)
        return (total[end] - total[start]) / (end - start)[:, None]

    return along(along(image).T).T

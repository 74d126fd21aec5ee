"""Distortion of lenses as OpenCV models it. Needs OpenCV."""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType

import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError, install_hint

Array = npt.NDArray[np.float64]


def distorted(flat: Array, K: Array, coefficients: Sequence[float], fisheye: bool) -> Array:
    """Positions (N, 2) in OpenCV's pixels of directions (N, 2), which are x / z and y / z in camera space.

    ``K`` (3, 3) and ``coefficients`` are OpenCV's; ``fisheye``: whether they are those of its module ``fisheye``.
    """
    if not any(coefficients) and not fisheye:
        return flat * np.diag(K)[:2] + K[:2, 2]
    cv2 = opencv()
    finite = np.where(np.isfinite(flat), flat, 0.0)
    rays, still = np.concatenate([finite, np.ones((len(flat), 1))], -1), np.zeros(3)
    if fisheye:
        placed, _ = cv2.fisheye.projectPoints(rays[:, None], still, still, K, np.array(coefficients or (0.0,) * 4))
    else:
        placed, _ = cv2.projectPoints(rays, still, still, K, np.array(coefficients))
        placed[_folded(coefficients, finite)] = -1e6
    return np.asarray(placed, np.float64).reshape(-1, 2)


def _folded(coefficients: Sequence[float], flat: Array) -> npt.NDArray[np.bool_]:
    """True for directions so far off the axis that the polynomial of distortion turns back: its picture there is none."""
    k = np.zeros(12)
    k[: len(coefficients)] = coefficients
    radius = np.linalg.norm(flat, axis=-1)
    steps = np.linspace(0, max(float(radius.max(initial=0.0)), 1e-6), 2048)
    r2 = steps**2
    with np.errstate(divide="ignore", invalid="ignore"):
        image = steps * (1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / (1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))
    back = np.nonzero(~(np.diff(image) > 0))[0]
    return radius > steps[back[0]] if len(back) else np.zeros(len(flat), bool)


def opencv() -> ModuleType:
    """The module ``cv2``. Raises ShadowmapError if OpenCV is not installed."""
    try:
        import cv2
    except ImportError:
        raise ShadowmapError(
            f"Cameras with distortion or other than square pixels need OpenCV: {install_hint('photos')}."
        ) from None
    return cv2

"""Reconstruction filters of films, and their weights on a grid of samples."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from ..errors import ShadowmapError

if TYPE_CHECKING:
    import mitsuba as mi

# Points at which a filter is sampled in each cell. 32 points make weights exact to about 1e-5.
POINTS = 32


@dataclass(frozen=True)
class Filter:
    """A separable reconstruction filter.

    kind     Mitsuba's name of its class
    radius   pixels beyond which it is zero
    border   pixels around the film whose samples contribute to it, Mitsuba's ``border_size``
    b, c     parameters of the cubic filters (Mitchell and Netravali's names)
    """

    kind: str
    radius: float
    border: int
    b: float = 0.0
    c: float = 0.0

    @classmethod
    def read(cls, film: mi.Film, owner: str) -> Filter:
        """The filter of a ``mi.Film``. Raises ``ShadowmapError`` for an unknown filter, naming ``owner``, the sensor.

        Nothing is read from the device, so this may run in a frozen function.
        """
        plugin = film.rfilter()
        kind, (b, c) = plugin.class_name(), (0.0, 0.5)
        if kind == "MitchellNetravaliFilter":
            found = re.search(r"\bB ?= ?([^,\]]+), C ?= ?([^,\]]+)", str(plugin))
            kind, (b, c) = (kind, (float(found[1]), float(found[2]))) if found else ("a Mitchell filter without B and C", (b, c))
        if kind not in _PROFILES:
            raise ShadowmapError(
                f"The film of sensor '{owner}' has the reconstruction filter {kind}, which is not supported: "
                "use box, tent, gaussian, mitchell, catmullrom or lanczos."
            )
        return cls(kind, float(plugin.radius()), int(plugin.border_size()), b, c)

    @property
    def is_box(self) -> bool:
        """True if a pixel is the plain mean of its own samples."""
        return self.kind == "BoxFilter"

    def evaluate(self, x: np.ndarray) -> np.ndarray:
        """Weights at distances ``x`` in pixels, not normalised."""
        return np.where(np.abs(x) <= self.radius, _PROFILES[self.kind](self, np.abs(x)), 0.0)

    @lru_cache(maxsize=64)  # noqa: B019  (a pure function of a few numbers, called at every step)
    def weights(self, factor: int) -> tuple[float, ...]:
        """Weights of the cells around a pixel's centre, ``factor`` cells to a pixel; symmetric, summing to 1.

        Cells have a width of their own: if each were weighted by the filter's integral over it, edges would be wider than the
        filter makes them, with one cell to a pixel by a fifth for a Gaussian. Instead the weighted cells turn an edge into the
        least-squares approximation of the blurred step that the filter makes of it. A filter that is nowhere negative gets no
        negative weights, which would make dark seams along bright edges.
        """
        most = factor * (2 * self.border + 1)
        reach = self.radius * factor - 1e-4
        count = 2 * math.ceil(reach) if factor % 2 == 0 else 2 * math.ceil(reach - 0.5) + 1
        count = max(min(count, most), 2 - factor % 2)
        weights = self._fit(count, factor)
        while count > 2 and self._positive and weights.min() < 0:
            count -= 2
            weights = self._fit(count, factor)
        return tuple(weights.tolist())

    @property
    def _positive(self) -> bool:
        return self.kind in ("BoxFilter", "TentFilter", "GaussianFilter")

    def _fit(self, count: int, factor: int) -> np.ndarray:
        """Weights of ``count`` cells. Their step is a linear spline with knots at the borders of cells, from 0 to 1."""
        across = (np.arange(count * POINTS) + 0.5) / (POINTS * factor) - 0.5 * count / factor
        fine = np.linspace(-self.radius, self.radius, 2 * POINTS * factor * math.ceil(self.radius) + 1)
        values = self.evaluate(0.5 * (fine[1:] + fine[:-1]))
        target = np.interp(across, fine, np.concatenate([[0.0], np.cumsum(values) / values.sum()]))
        # Hat functions at the knots, sampled. The values at the first and the last knot are given: 0 and 1.
        at = across * factor + 0.5 * count
        hats = np.maximum(0.0, 1.0 - np.abs(at[:, None] - np.arange(count + 1)))
        inner, *_ = np.linalg.lstsq(hats[:, 1:-1], target - hats[:, -1], rcond=None)
        weights = np.diff(np.concatenate([[0.0], inner, [1.0]]))
        return 0.5 * (weights + weights[::-1])


def _cubic(filter: Filter, x: np.ndarray) -> np.ndarray:
    b, c = filter.b, filter.c
    near = (12 - 9 * b - 6 * c) * x**3 + (-18 + 12 * b + 6 * c) * x**2 + 6 - 2 * b
    far = (-b - 6 * c) * x**3 + (6 * b + 30 * c) * x**2 + (-12 * b - 48 * c) * x + 8 * b + 24 * c
    return np.where(x < 1, near, np.where(x < 2, far, 0.0)) / 6


def _gaussian(filter: Filter, x: np.ndarray) -> np.ndarray:
    # Cut off at four standard deviations, and lowered so that it ends at zero.
    return np.exp(-8.0 * (x / filter.radius) ** 2) - math.exp(-8.0)


_PROFILES = {
    "BoxFilter": lambda filter, x: np.ones_like(x),
    "TentFilter": lambda filter, x: 1 - x / filter.radius,
    "GaussianFilter": _gaussian,
    "MitchellNetravaliFilter": _cubic,
    "CatmullRomFilter": _cubic,
    "LanczosSincFilter": lambda filter, x: np.sinc(x) * np.sinc(x / filter.radius),
}

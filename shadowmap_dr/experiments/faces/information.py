"""Information of a shadow image about the weights of a morphable model: derivatives by the weights, against their prior."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...inverse.faces.morph_fit import MorphFit
from ...jit.arrays import device_array

FloatArray = npt.NDArray[np.float64]

#: A weight counts as visible if its posterior standard deviation is at most this; that of the prior is 1.
SEEN = 0.5
_SIDES = re.compile(r"(.*?)[ _]?(Left|Right|_L|_R)$")


@dataclass(frozen=True)
class Contrast:
    """A weight, or the sum or difference of a left and a right weight, as a unit vector (N,) of weights."""

    name: str
    vector: FloatArray


def image_derivatives(fit: MorphFit, parameters: npt.ArrayLike) -> FloatArray:
    """(pixels, N): derivative of the visibility of each pixel by each weight (not by a translation), forward mode."""
    at = np.asarray(parameters, np.float32).reshape(-1)
    columns = []
    for k in range(fit.count):
        values = device_array(mi.Float, at)
        dr.enable_grad(values)
        dr.set_grad(values, device_array(mi.Float, np.eye(len(at))[k]))
        columns.append(np.array(dr.forward_to(fit.image(values)), dtype=np.float64))
    return np.stack(columns, 1)


def posterior_covariance(derivatives: npt.ArrayLike, prior: float) -> FloatArray:
    """(N, N) posterior covariance of weights with a standard normal prior, given an image (Laplace's approximation).

    Args:
        derivatives: (pixels, N), see `image_derivatives`.
        prior: as of `MorphFit`, above 0: it fixes the standard deviation s of a pixel.

    The Fisher information of the image, J^T J / s^2 with s^2 = prior * pixels / N, is added to that of the prior.
    """
    j = np.asarray(derivatives, np.float64)
    if not prior > 0:
        raise ShadowmapError("without a prior there is no scale for what a shadow tells: give one above 0.")
    pixels, count = j.shape
    return np.linalg.inv(np.eye(count) + j.T @ j * (count / (prior * pixels)))


def contrasts(names: tuple[str, ...]) -> list[Contrast]:
    """The weights by name; for left and right pairs (``...Left``, ``..._L``), their sum and their difference.

    A profile does not show which side of the face moves: of a pair, only the sum is visible.
    """
    pairs: dict[str, dict[str, int]] = {}
    for k, name in enumerate(names):
        match = _SIDES.match(name)
        if match:
            pairs.setdefault(match[1], {})[match[2].strip("_")[0]] = k
    whole = {k for pair in pairs.values() if set(pair) == {"L", "R"} for k in pair.values()}
    unit, result = np.eye(len(names)), []
    for stem, pair in pairs.items():
        if set(pair) == {"L", "R"}:
            left, right = unit[pair["L"]], unit[pair["R"]]
            result.append(Contrast(f"{stem}, both sides", (left + right) / np.sqrt(2)))
            result.append(Contrast(f"{stem}, left against right", (left - right) / np.sqrt(2)))
    return result + [Contrast(name, unit[k]) for k, name in enumerate(names) if k not in whole]


def recovery(
    names: tuple[str, ...], covariance: npt.ArrayLike, true: npt.ArrayLike, found: npt.ArrayLike
) -> list[dict[str, Any]]:
    """For each contrast, the best determined first: posterior standard deviation, true value, found value and error."""
    c, error = np.asarray(covariance, np.float64), np.asarray(found, np.float64) - np.asarray(true, np.float64)
    rows = []
    for contrast in contrasts(names):
        v = contrast.vector
        rows.append(
            {
                "name": contrast.name,
                "deviation": float(np.sqrt(v @ c @ v)),
                "true": float(v @ np.asarray(true)),
                "found": float(v @ np.asarray(found)),
                "error": float(v @ error),
            }
        )
    return sorted(rows, key=lambda row: row["deviation"])

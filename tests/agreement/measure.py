"""Errors of the plug-in against Mitsuba's references, in primal, forward and reverse mode."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

import shadowmap_dr  # noqa: F401  (registers the integrator)

from . import references
from .cases import OPTIONS, Case, Changing
from .report import TOLERANCES

MODES = tuple(TOLERANCES)
# Values below these are divided by them instead of by themselves, as in Mitsuba's tests.
_LEAST = {"primal": 2e-2, "forward": 2e-1}


@dataclass(frozen=True)
class Error:
    """Mean and largest relative error over all pixels and channels; both are the same number in reverse mode."""

    mean: float
    largest: float


def error(case: Case, mode: str, options: Any = None) -> Error:
    """Error of the plug-in for a case in one of ``MODES``; ``options`` (a dictionary) replace all that the case has."""
    reference = _reference(case)
    options = {**OPTIONS, **(case.options or {})} if options is None else options
    if mode == "reverse":
        found = abs(reverse(case, references.weights(reference.image.shape), options) / reference.slope - 1)
        return Error(found, found)
    image, expected = (
        (primal(case, options), reference.image) if mode == "primal" else (forward(case, options), reference.derivative)
    )
    relative = np.abs(image - expected) / np.maximum(np.abs(expected), _LEAST[mode])
    return Error(float(relative.mean()), float(relative.max()))


def primal(case: Case, options: Any) -> np.ndarray:
    """Image (H, W, 3)."""
    return np.array(_plugin(options).render(Changing(case).scene, seed=0, spp=case.spp))


def forward(case: Case, options: Any) -> np.ndarray:
    """Derivative (H, W, 3) of the image by the case's number."""
    changing, t = Changing(case), mi.Float(0)
    dr.enable_grad(t)
    changing.set(t)
    dr.forward(t, dr.ADFlag.ClearEdges)
    return np.array(_plugin(options).render_forward(changing.scene, changing.params, seed=0, spp=case.spp))


def reverse(case: Case, adjoint: np.ndarray, options: Any) -> float:
    """Derivative of <adjoint, image> by the case's number."""
    changing, t = Changing(case), mi.Float(0)
    dr.enable_grad(t)
    changing.set(t)
    gradient = mi.TensorXf(adjoint.astype(np.float32))
    _plugin(options).render_backward(changing.scene, changing.params, gradient, seed=0, spp=case.spp)
    return float(dr.grad(t)[0])


def _plugin(options: Any) -> Any:
    return mi.load_dict({"type": "shadowmap", **options})


@cache
def _reference(case: Case) -> references.Reference:
    return references.load(case)

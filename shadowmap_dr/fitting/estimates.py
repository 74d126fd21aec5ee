"""Estimates of a fit, with names, units and intervals; and the fitted values by the names of Mitsuba's parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import drjit as dr
import numpy as np
import numpy.typing as npt

from ..rendering.renderer import Renderer
from .arrays import ArrayParameter
from .changes import Changes
from .gains import Gain
from .motions import host_matrix, tangents
from .parameters import Parameter
from .result import Estimate
from .scene_change import SceneChange
from .texture_brightness import TextureBrightness
from .uncertainty import Uncertainty

Array = npt.NDArray[np.float64]

# Gains are logarithms; a stop is a factor of two.
_STOP = math.log(2)
# Names of Mitsuba's parameters by fields of lights' records.
_LIGHT_KEYS = {
    "irradiance": "irradiance.value",
    "intensity": "intensity.value",
    "position": "position",
    "cutoff_angle": "cutoff_angle",
    "beam_width": "beam_width",
}


def estimates_of(
    x: Array, parameters: Sequence[Parameter], renderer: Renderer, change: SceneChange, spread: Uncertainty
) -> tuple[list[Estimate], list[str]]:
    """(estimates of parameters at the numbers x, names of these numbers).

    Args:
        change: the change of the scene at x.
        spread: uncertainty of the numbers.
    """
    estimates: list[Estimate] = []
    names: list[str] = []
    half, at = spread.half_widths, 0
    for parameter in parameters:
        count, scale, label = len(parameter.labels), parameter.scale, parameter.vary.label
        own = slice(at, at + count)
        at += count
        with np.errstate(invalid="ignore"):
            widths = np.where(np.isfinite(half[own]), scale.widths(x[own], half[own]), np.inf)
        shown = scale.shown(x[own]), scale.shown(np.zeros(count)), widths
        if not isinstance(parameter, TextureBrightness):  # part of the texture
            arrays = parameter.arrays(renderer, change)
            estimates.append(Estimate(label, parameter.kind, parameter.labels, parameter.units, *shown, arrays=arrays))
        names += [label if count == 1 else f"{label} {one}" for one in parameter.labels]
    return estimates, names


def gain_estimates(
    x: Array, pictures: Sequence[str], gains: Sequence[Gain], places: Sequence[slice], spread: Uncertainty
) -> tuple[list[Estimate], list[str]]:
    """(estimates of the pictures' gains, names of their numbers). ``pictures``: names; ``places``: of the gains' numbers in x."""
    estimates: list[Estimate] = []
    names: list[str] = []
    half = spread.half_widths
    for name, gain, own in zip(pictures, gains, places, strict=True):
        shown = name or "the picture"
        if gain.colours:
            one = slice(own.start, own.start + gain.colours)
            kind = "exposure" if gain.colours == 1 else "white balance"
            labels = ("exposure",) if gain.colours == 1 else ("red", "green", "blue")
            values = x[one] / _STOP, np.zeros(gain.colours), half[one] / _STOP
            estimates.append(Estimate(f"{kind} of {shown}", kind, labels, ("stops",) * gain.colours, *values))
            names += [f"{kind} of {shown}" if gain.colours == 1 else f"{kind} of {shown}, {label}" for label in labels]
        if gain.vignetting:
            last = slice(own.stop - 1, own.stop)
            values = x[last], np.zeros(1), half[last]
            estimates.append(Estimate(f"vignetting of {shown}", "vignetting", ("in the corners",), ("",), *values))
            names.append(f"vignetting of {shown}")
    return estimates, names


def array_estimates(arrays: Sequence[ArrayParameter], values: Sequence[npt.NDArray[np.float32]]) -> list[Estimate]:
    """Estimates of parameters with many values: without intervals."""
    return [
        Estimate(
            array.vary.label, array.kind, (), (), own.astype(np.float64), array.start.astype(np.float64), None, array.arrays(own)
        )
        for array, own in zip(arrays, values, strict=True)
    ]


def changes_of(change: SceneChange, renderer: Renderer) -> Changes:
    """A change of a scene for files."""
    values: dict[str, npt.NDArray[np.float64]] = {}
    for key, parts in change.values.items():
        values[key] = np.array([float(dr.detach(part)[0]) for part in parts])
    for key, (array, shape) in change.arrays.items():
        values[key] = np.array(dr.detach(array), np.float64).reshape(shape)
    for name, light in change.lights.items():
        values |= _light_values(name, renderer.light(name), light)
    for number, camera in change.cameras.items():
        old = renderer.data.cameras(number)[0]
        if camera.to_world is not old.to_world:
            values[f"{old.name}.to_world"] = host_matrix(camera.to_world)
        if camera.x_fov is not old.x_fov:
            values[f"{old.name}.x_fov"] = np.array(dr.detach(camera.x_fov), np.float64)
    transforms = {name: host_matrix(matrix) for name, matrix in change.placements.items()}
    vertices = {name: np.array(dr.detach(flat), np.float64).reshape(-1, 3) for name, flat in change.vertices.items()}
    for name in [name for name in vertices if name in transforms]:  # in files, vertices are final
        matrix = transforms.pop(name)
        vertices[name] = vertices[name] @ matrix[:3, :3].T + matrix[:3, 3]
    return Changes(values=values, transforms=transforms, vertices=vertices)


def _light_values(name: str, old: Any, new: Any) -> dict[str, npt.NDArray[np.float64]]:  # Any: one of several records
    """Values of a changed light by the names of Mitsuba's parameters."""
    changed = {field for field in vars(new) if getattr(new, field) is not getattr(old, field)}
    values: dict[str, npt.NDArray[np.float64]] = {}
    for field, key in _LIGHT_KEYS.items():
        if field in changed:
            values[f"{name}.{key}"] = np.array(dr.detach(getattr(new, field)), np.float64).ravel()
    if "to_world" in changed:
        values[f"{name}.to_world"] = host_matrix(new.to_world)
    if "direction" in changed:
        forward = np.array(dr.detach(new.direction), np.float64).ravel()
        side, up = tangents(forward)
        matrix = np.eye(4)
        matrix[:3, :3] = np.stack([side, up, forward / np.linalg.norm(forward)], axis=1)
        values[f"{name}.to_world"] = matrix
    return values

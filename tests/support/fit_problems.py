"""Problems for the command `fit`, and records of fits to them."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from shadowmap_dr.experiments.bench.fits import catalogue, score, variations
from shadowmap_dr.experiments.bench.fits.problem import FitProblem
from shadowmap_dr.experiments.bench.fits.scenes import Scene

EVERY = (*catalogue.scored(), *catalogue.calibration())
NAMES = [problem.name for problem in EVERY]
SMALL = [one for one in EVERY if not {v.kind for v in one.varied} & {"texture", "vertices"}]


def record_of(problem: FitProblem, start: Scene, at: Scene, exposure: float = 1.0, width: float = 0.1) -> dict[str, Any]:
    """A fit.json whose fit is the scene ``at``; exposures are the true ones times a factor."""
    estimates = []
    for one in problem.varied:
        holder = start.holds(one.part)
        entry: dict[str, Any] = {"name": one.name, "kind": one.kind, "labels": [], "units": []}
        numbers: list[float] = []
        if one.kind == "value":
            numbers = variations.value(at, one).tolist()
            entry |= {"value": numbers, "labels": ["red", "green", "blue"][: len(numbers)]}
        elif one.kind == "fov":
            numbers = [at.camera(one.part).fov]
            entry |= {"value": numbers, "labels": ["angle of view"]}
        elif one.kind not in ("texture", "vertices"):
            old, new = (getattr(scene, holder)(one.part).place for scene in (start, at))
            entry["matrix"] = (new @ np.linalg.inv(old)).tolist()
            if holder == "lamp":
                entry |= {"direction": new[:3, 2].tolist(), "position": new[:3, 3].tolist()}
            entry |= {"labels": labels_of(one, holder), **turning(start, one.part)}
            found = score.true_numbers(at, start, one, entry)
            numbers = [0.0 if number is None else number for number in found]
        estimates.append({**entry, "values": numbers, "half_width": [width] * len(numbers)})
    pictures = []
    for name, photo in zip(problem.targets(), problem.photographs, strict=True):
        factor = photo.exposure * exposure
        pictures.append({"name": name, "exposure": factor, "error": 0.01})
        estimates.append(
            {
                "name": f"exposure of {name}",
                "kind": "exposure",
                "labels": ["exposure"],
                "units": ["stops"],
                "values": [float(np.log2(factor))],
                "half_width": [width],
            }
        )
    return {"found": True, "words": [], "unexplained": 0.01, "estimates": estimates, "pictures": pictures}


def turning(start: Scene, part: str) -> dict[str, Any]:
    """Point and axes of rotations: the middle of a shape's box and those of the world; a light's and a camera's own."""
    holder = start.holds(part)
    if holder == "body":
        return {"pivot": start.body(part).centre().tolist(), "axes": np.eye(3).tolist()}
    place = getattr(start, holder)(part).place
    return {"pivot": place[:3, 3].tolist(), "axes": place[:3, :3].tolist()}


def labels_of(one: variations.Variation, holder: str) -> list[str]:
    """Labels that the command gives the numbers of a motion."""
    turns = ["tilt", "pan", "roll"] if holder == "camera" else [f"rotation {axis}" for axis in "xyz"]
    moves = [f"translation {axis}" for axis in (one.detail if one.kind == "translation" else "xyz")]
    if holder == "lamp" and one.kind == "pose":
        turns = ["turn 1", "turn 2"]
    return {
        "pose": [*turns, *moves],
        "rotation": [f"rotation {one.detail}"],
        "translation": moves,
        "position": moves,
        "scale": ["scale"],
        "direction": ["turn 1", "turn 2"],
    }[one.kind]


def quick(problem: FitProblem, **changes: Any) -> FitProblem:
    """A problem with small pictures of few samples."""
    cameras = tuple(dataclasses.replace(camera, width=32, height=24) for camera in problem.truth.cameras)
    return dataclasses.replace(problem, truth=dataclasses.replace(problem.truth, cameras=cameras), spp=4, **changes)

"""Results of fits that never ran."""

from __future__ import annotations

from typing import Any

import numpy as np

from shadowmap_dr.fitting.result import Estimate, FitResult, Picture, Step

LABELS = tuple(f"{kind} {axis}" for kind in ("rotation", "translation") for axis in "xyz")


def estimate(**changes: Any) -> Estimate:  # Any: entries of an Estimate
    """The pose of a bunny. Its translation z is not determined."""
    entries: dict[str, Any] = {
        "name": "bunny:pose",
        "kind": "pose",
        "labels": LABELS,
        "units": ("deg",) * 3 + ("",) * 3,
        "values": np.array([0.1234, -12.345, 3.0, 0.5, 0.25, -0.125]),
        "start": np.zeros(6),
        "half_width": np.array([0.01, 0.034, 0.1, 0.0014, 0.002, np.inf]),
        "arrays": {"matrix": np.eye(4) + 0.25},
    }
    return Estimate(**{**entries, **changes})


def vertices(**changes: Any) -> Estimate:  # Any: entries of an Estimate
    """A mesh that was moved by 0.5, with no intervals."""
    moved = np.full((5, 3), 0.5)
    entries: dict[str, Any] = {
        **{"name": "bunny:vertices", "kind": "vertices", "labels": (), "units": ("",)},
        **{"values": moved.ravel(), "start": np.zeros(15), "half_width": None, "arrays": {"vertices": moved}},
    }
    return Estimate(**{**entries, **changes})


def picture(height: int = 24, width: int = 32, **changes: Any) -> Picture:  # Any: entries of a Picture
    """A bright disc before a grey wall; the start is off to the left, the fit nearly right. The uppermost rows do not count."""
    y, x = np.mgrid[:height, :width] / height

    def disc(centre: float, size: int = 1) -> np.ndarray[Any, np.dtype[np.float32]]:
        image = np.where((x - centre) ** 2 + (y - 0.5) ** 2 < 0.09, 0.8, 0.2)[::size, ::size]
        return np.repeat(image[..., None], 3, axis=2).astype(np.float32)

    weight = np.ones((height, width), np.float32)
    weight[: height // 8] = 0
    frames = [(f"{width // size} px, step {k}", disc(0.4 + 0.05 * k, size)) for k, size in enumerate((4, 4, 2, 2, 1, 1))]
    entries: dict[str, Any] = {
        **{"target": disc(0.7), "start": disc(0.4), "fit": disc(0.69), "weight": weight, "shadows": np.ones((height, width))},
        **{"frames": frames, "name": "photo.png", "exposure": 1.25},
    }
    return Picture(**{**entries, **changes})


def history(starts: int = 3, steps: int = 6) -> list[Step]:
    """Errors that fall from step to step, at 16 and then at 32 pixels."""
    entries: list[Step] = []
    for start in range(starts):
        for k in range(2 * steps):
            stage, step = ("16 px", k) if k < steps else ("32 px", k - steps)
            error, seconds = 0.5 / (1 + k) + 0.01 * start, 0.1 * (k + 1) + 0.01 * start
            entries.append({"start": start, "stage": stage, "step": step, "error": error, "seconds": seconds})
    return entries


def result(**changes: Any) -> FitResult:  # Any: entries of a FitResult
    """A fit of a pose and of a mesh, which was found."""
    names = [*(f"bunny:pose {label}" for label in LABELS), "exposure of photo.png"]
    correlations = np.eye(7)
    correlations[0, 1] = correlations[1, 0] = -0.97
    entries: dict[str, Any] = {
        **{"found": True, "words": ["translation z is not determined."], "unexplained": 0.02},
        **{"estimates": [estimate(), vertices()]},
        **{"correlations": correlations, "names": names, "pictures": [picture()], "history": history(), "seconds": 12.5},
        **{"command": "shadowmap-dr fit scene.xml --target photo.png", "settings": {"starts": 3, "vary": ["bunny:pose"]}},
    }
    return FitResult(**{**entries, **changes})

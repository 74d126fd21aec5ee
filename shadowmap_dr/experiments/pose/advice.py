"""Reasons why a run did not find the pose, and what to try."""

from __future__ import annotations

from typing import Any

import numpy as np

from .scene import PoseProblem, pose_errors
from .search import EXPLAINED, facet_widths, narrow_width

# An object's own size: half the side of the cube that holds it.
_HALF_SIDE = 1.0
# Loss of the last tenth of the steps by that of the tenth before it.
_FALLING = 0.8
# Mean squared difference that an object without effect on the image leaves; errors of images are larger.
_NO_EFFECT = 1e-7
# Rotation between two poses that look alike, in degrees.
_OTHER_POSE_DEG = 5.0
_SAMPLE_GRIDS = (1, 4, 16, 64)


def reasons(record: dict[str, Any], problem: PoseProblem) -> list[str]:
    """Clauses for a record of `make_record`: why the pose may not have been found, and what to try. Empty if it was found."""
    if record["recovered"]:
        return []
    if None in record["final"] or record["rotation_error_deg"] is None:
        return ["the loss or the pose was not finite; report this with the object"]
    # Records of earlier versions do not say how much of an image is explained.
    if record.get("without_object", 1.0) < _NO_EFFECT:
        return ["neither the object nor its shadow is in view, so that nothing in the image tells the pose"]
    result = []
    if record["method"] == "rasterizer" and record["shadow_only"]:
        return ["the object is out of view and this method has no shadows; try --method shadows"]
    left: float = np.nan if record.get("unexplained") is None else record["unexplained"]
    rotation, offset = pose_errors(record["final"])
    far, near = left > EXPLAINED, left <= EXPLAINED  # neither for NaN
    if far and 0.01 * offset > 2 * _HALF_SIDE:
        result.append("the object left the view; try more --samples, or a --blur of a sixteenth of the image")
    elif far and record["method"] == "shadows":  # the others' images lack the shadows, or are noisy
        tries = "more --tries" if len(record["tries"]) > 1 else "--tries 5"
        result.append(
            f"the image differs by {100 * left:.0f} % as much as without the object: another pose with a similar shadow; "
            f"try {tries}, a larger --blur, or another --seed"
        )
    if record["method"] == "mitsuba":
        if record["settings"].get("fair") is False:
            result.append("sample counts that converge here are not known; see docs/pose.md")
    elif record["method"] == "rasterizer":
        result.append("this method has no shadows; try --method shadows")
    else:
        samples = record["settings"].get("samples_per_pixel", 1)
        width = narrow_width(facet_widths(problem))
        more = next((count for count in _SAMPLE_GRIDS if count > samples), None)
        if width * np.sqrt(samples) < 1 and more is not None:
            result.append(f"a tenth of the object's area lies in facets below {width:.2g} pixels; try --samples {more}")
    if _is_falling(record["loss_curve"]):
        result.append(f"the loss was still falling; try --iterations {2 * record['iterations']}")
    if near and rotation > _OTHER_POSE_DEG:
        result.append("another pose gives nearly the same image, as of a symmetric object; try another camera or object")
    elif near and not result:
        result.append("the pose is nearly found, and trembles with the step size; try more --samples or a larger --resolution")
    return result or ["the search ended at another pose; try more --iterations, or another --seed"]


def _is_falling(curve: list[float | None]) -> bool:
    """True if a loss falls by a fifth from the last but one tenth of its steps to the last."""
    values = [value for value in curve if value is not None]
    tenth = len(values) // 10
    if not tenth or len(values) < len(curve):
        return False
    return float(np.mean(values[-tenth:])) < _FALLING * float(np.mean(values[-2 * tenth : -tenth]))

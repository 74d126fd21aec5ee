"""Reasons why a shadow does not match its target, and what to try."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

#: Smaller intersections over unions are worth a warning.
GOOD = 0.9
# Share of holes, width of lines in pixels, and gain within the last tenth of the steps that are worth a word.
_HOLES, _THIN, _RISING = 0.02, 6.0, 0.005
_MOST_PIECES = 20

Array = npt.NDArray[np.float32]


def warnings_of(record: dict[str, Any], targets: list[Array], *, fill_holes: bool) -> list[str]:
    """A warning for each view of a record of `run_art` that matches badly. ``targets``: (H, W) visibility."""
    collection = "collection" in record["settings"]
    result = []
    for k, (view, target) in enumerate(zip(record["views"], targets, strict=True)):
        if view["iou"] >= GOOD:
            continue
        reasons = []
        if view["holes"] > _HOLES and not fill_holes and not collection:
            reasons.append(f"the figure has holes ({100 * view['holes']:.0f} % of it); try --fill-holes or --collection")
        count = pieces(target)
        if count > 1 and not collection:
            more = "more than " if count > _MOST_PIECES else ""
            reasons.append(f"the figure has {more}{min(count, _MOST_PIECES)} pieces; try --collection, or a clearer picture")
        width = thickness(target)
        if width < _THIN:
            reasons.append(f"its parts are {width:.1f} pixels wide; try a larger --resolution or a more compact figure")
        curve = [values[k] for values in record["iou_curve"]["iou"]]
        if len(curve) > 1 and curve[-1] - curve[-1 - max(1, len(curve) // 10)] > _RISING:
            reasons.append("it was still improving; try more --iterations")
        if not reasons:
            reasons.append("the surface is too stiff or the figure too detailed; try a smaller --smoothness or a simpler figure")
        result.append(
            f"the shadow of {record['settings']['targets'][k]} matches badly (IoU {view['iou']:.3f}): {'; '.join(reasons)}. "
            f"target-{k + 1}.png shows what was understood."
        )
    return result


def thickness(target: Array) -> float:
    """Mean width of the dark parts in pixels: twice their area by the length of their outline."""
    dark = np.pad(target < 0.5, 1)
    outline = sum(np.count_nonzero(np.diff(dark, axis=axis)) for axis in (0, 1))
    return 2 * np.count_nonzero(dark) / max(outline, 1)


def pieces(target: Array) -> int:
    """Number of dark pieces that do not touch; counting ends after 20."""
    from PIL import Image, ImageDraw

    image = Image.fromarray((np.asarray(target) < 0.5).astype(np.uint8) * 255).copy()
    count = 0
    while count <= _MOST_PIECES:
        rows, columns = np.nonzero(np.asarray(image) == 255)
        if not len(rows):
            break
        ImageDraw.floodfill(image, (int(columns[0]), int(rows[0])), 128)
        count += 1
    return count

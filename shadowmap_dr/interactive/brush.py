"""The brush: how much of each pixel a stroke covers."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

Bytes = npt.NDArray[np.uint8]
Line = npt.NDArray[np.float64]
#: Rows and columns of a rectangle of pixels.
Box = tuple[slice, slice]
# Pixels that one part of a line may touch. Drawing so many takes a few milliseconds.
_MOST_PIXELS = 100_000


def cover(coverage: Bytes, line: Line, radius: float) -> Box | None:
    """Draw a line with round ends into a coverage (H, W), 0 to 255, in place. The edge is one pixel soft.

    Args:
        coverage: keeps the larger value where it is covered already.
        line: points (N, 2), x to the right and y down from the top left corner, in pixels.
        radius: in pixels.

    Returns the smallest rectangle with all pixels that may have changed, None for a line outside of the image.
    """
    boxes = []
    for a, b in _segments(line):
        rows, columns = _box(a, b, radius)
        part = coverage[rows, columns]
        if not part.size:
            continue
        boxes.append((rows.start, rows.start + part.shape[0], columns.start, columns.start + part.shape[1]))
        x = columns.start + np.arange(part.shape[1]) + 0.5 - a[0]
        y = (rows.start + np.arange(part.shape[0]) + 0.5 - a[1])[:, None]
        along = b - a
        length = along @ along
        t = np.clip((x * along[0] + y * along[1]) / length, 0, 1) if length > 0 else 0.0
        distance = np.hypot(x - t * along[0], y - t * along[1])
        np.maximum(part, np.rint(255 * np.clip(radius + 0.5 - distance, 0, 1)).astype(np.uint8), out=part)
    if not boxes:
        return None
    top, bottom, left, right = zip(*boxes, strict=True)
    return slice(min(top), max(bottom)), slice(min(left), max(right))


def parts(line: Line, radius: float, shape: tuple[int, int]) -> Iterator[Line]:
    """Split a line (N, 2) into lines that each take a few milliseconds to draw. Each one begins where the last one ended.

    The parts cover the same pixels as the whole line.
    """
    start = pixels = 0
    for k, (a, b) in enumerate(_segments(line)):
        rows, columns = _box(a, b, radius)
        height, width = (max(min(s.stop, most) - s.start, 0) for s, most in zip((rows, columns), shape, strict=True))
        if pixels and pixels + height * width > _MOST_PIXELS:
            yield line[start : k + 1]
            start, pixels = k, 0
        pixels += height * width
    yield line[start:]


def _segments(line: Line) -> Iterator[tuple[Line, Line]]:
    """Ends of the segments of a line. A single point is a segment without length."""
    starts = line[:-1] if len(line) > 1 else line
    ends = line[1:] if len(line) > 1 else line
    return zip(starts, ends, strict=True)


def _box(a: Line, b: Line, radius: float) -> Box:
    """Rectangle around a segment. It may reach beyond the right and lower edge of the image."""
    (x0, y0), (x1, y1) = np.minimum(a, b) - radius - 1, np.maximum(a, b) + radius + 1
    columns = slice(max(int(x0), 0), max(int(np.ceil(x1)), 0))
    return slice(max(int(y0), 0), max(int(np.ceil(y1)), 0)), columns

"""The image that is painted on: strokes and images, one over the other, each of which can be undone."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError

#: So many of the latest edits can be undone.
HISTORY = 50

Mode = Literal["add", "erase"]
Array = npt.NDArray[np.float32]
Bytes = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class _Edit:
    """Something painted: a tone from 0 (dark) to 255 (lit) where it covers the canvas, by 0..255."""

    key: Hashable
    tone: int | Bytes
    cover: Bytes | None  # None: all of it

    def over(self, below: Bytes) -> Bytes:
        if self.cover is None:
            return np.array(np.broadcast_to(np.uint8(self.tone), below.shape))
        change = np.subtract(self.tone, below, dtype=np.int32) * self.cover
        return (below + np.rint(change / 255).astype(np.int32)).astype(np.uint8)


class Canvas:
    """A painted shadow. Several people may paint at once: undoing one stroke leaves the others as they are.

    Not thread-safe; strokes take well under a millisecond at 256 x 256.

    Args:
        start: visibility (H, W), 0 (dark) to 1 (lit), top row first: what is painted on.

    Attributes:
        version: grows with every change.
    """

    def __init__(self, start: npt.ArrayLike) -> None:
        self._start = _bytes(start)
        self._base = self._start
        self._edits: list[_Edit] = []
        self._undone: list[_Edit] = []
        self._image = self._below = self._base
        self.version = 0

    @property
    def shape(self) -> tuple[int, int]:
        height, width = self._start.shape
        return height, width

    @property
    def can_undo(self) -> bool:
        return bool(self._edits)

    @property
    def can_redo(self) -> bool:
        return bool(self._undone)

    def pixels(self) -> Bytes:
        """(H, W), 0 (dark) to 255 (lit). Do not write into it."""
        return self._image

    def target(self) -> Array:
        """(H, W), visibility from 0 to 1, a copy."""
        return np.divide(self._image, 255, dtype=np.float32)

    def stroke(self, key: Hashable, mode: Mode, radius: float, points: npt.ArrayLike) -> None:
        """Paint along a line, round, with an edge one pixel soft. A stroke does not get darker where it crosses itself.

        Args:
            key: names the stroke: further calls with it go on with the same one, and are undone with it.
            mode: ``add`` or ``erase`` shadow.
            radius: in pixels.
            points: (N, 2), x to the right and y down from the top left corner, in pixels.
        """
        line = np.asarray(points, np.float64).reshape(-1, 2)
        if mode not in ("add", "erase"):
            raise ShadowmapError(f"a stroke to {mode!r}: choose add or erase.")
        if not (0 < radius < np.inf and len(line) and np.isfinite(line).all()):
            raise ShadowmapError(f"a stroke of {len(line)} points and radius {radius}: give finite ones, at least one point.")
        known = ((k, edit.cover) for k, edit in enumerate(self._edits) if edit.key == key and edit.cover is not None)
        index, cover = next(known, (None, None))
        if index is None or cover is None:
            cover = np.zeros(self.shape, np.uint8)
            self._push(_Edit(key, 0 if mode == "add" else 255, cover))
            index = len(self._edits) - 1
        _cover(cover, line, radius)
        self._undone.clear()
        self._changed(above=index)

    def replace(self, image: npt.ArrayLike) -> None:
        """Put an image (H, W) over all that has been painted; can be undone."""
        self._push(_Edit(None, _bytes(image, self.shape), None))
        self._undone.clear()
        self._changed()

    def clear(self) -> None:
        """Back to the first image; can be undone."""
        self.replace(self._start.astype(np.float32) / 255)

    def undo(self) -> bool:
        """Take away the newest edit; False if there is none that is remembered."""
        if not self._edits:
            return False
        self._undone.append(self._edits.pop())
        self._changed()
        return True

    def redo(self) -> bool:
        """Put back what was undone last, unless something has been painted since."""
        if not self._undone:
            return False
        self._edits.append(self._undone.pop())
        self._changed()
        return True

    def _push(self, edit: _Edit) -> None:
        self._edits.append(edit)
        if len(self._edits) > HISTORY:
            self._base = self._edits.pop(0).over(self._base)
        self._below = _pile(self._base, self._edits[:-1])

    def _changed(self, above: int = -1) -> None:
        """The image anew. Mostly it is the topmost edit that has changed: what lies below it is kept."""
        if above != len(self._edits) - 1:
            self._below = _pile(self._base, self._edits[:-1])
        self._image = _pile(self._below, self._edits[-1:])
        self.version += 1


def _pile(base: Bytes, edits: Sequence[_Edit]) -> Bytes:
    for edit in edits:
        base = edit.over(base)
    return base


def _cover(cover: Bytes, line: npt.NDArray[np.float64], radius: float) -> None:
    """Adds a round-ended line (N, 2) to a coverage, in place."""
    starts = line[:-1] if len(line) > 1 else line
    ends = line[1:] if len(line) > 1 else line
    for a, b in zip(starts, ends, strict=True):
        (x0, y0), (x1, y1) = np.minimum(a, b) - radius - 1, np.maximum(a, b) + radius + 1
        columns = slice(max(int(x0), 0), max(int(np.ceil(x1)), 0))
        rows = slice(max(int(y0), 0), max(int(np.ceil(y1)), 0))
        part = cover[rows, columns]
        if not part.size:
            continue
        x = columns.start + np.arange(part.shape[1]) + 0.5 - a[0]
        y = (rows.start + np.arange(part.shape[0]) + 0.5 - a[1])[:, None]
        along = b - a
        length = along @ along
        t = np.clip((x * along[0] + y * along[1]) / length, 0, 1) if length > 0 else 0.0
        distance = np.hypot(x - t * along[0], y - t * along[1])
        np.maximum(part, np.rint(255 * np.clip(radius + 0.5 - distance, 0, 1)).astype(np.uint8), out=part)


def _bytes(image: npt.ArrayLike, shape: tuple[int, int] | None = None) -> Bytes:
    pixels = np.asarray(image, np.float32)
    if pixels.ndim != 2 or (shape is not None and pixels.shape != shape) or not np.isfinite(pixels).all():
        raise ShadowmapError(f"an image of shape {pixels.shape} to paint on: give finite numbers (H, W), always the same.")
    return np.rint(255 * pixels.clip(0, 1)).astype(np.uint8)

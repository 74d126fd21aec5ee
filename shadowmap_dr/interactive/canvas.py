"""The image that is painted on. Strokes and images lie on top of each other, and each of them can be undone."""

from __future__ import annotations

import itertools
from collections.abc import Hashable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError
from . import brush
from .brush import Box, Bytes

#: Number of the newest edits that can be undone.
HISTORY = 50

Mode = Literal["add", "erase"]
Array = npt.NDArray[np.float32]
_ALL: Box = (slice(None), slice(None))


@dataclass(frozen=True)
class Change:
    """An edit that has been undone or redone.

    Attributes:
        edit: number of the edit.
        exact: the canvas looks as it did right before (undone) or right after (redone) the edit. False after an older stroke,
            of somebody else, went on in the meantime.
    """

    edit: int
    exact: bool


@dataclass
class _Edit:
    """A painted tone, 0 (dark) to 255 (lit), mixed with the image below it by its coverage, 0 to 255."""

    number: int
    key: Hashable
    tone: int | Bytes
    coverage: Bytes | None  # None: covers everything
    below_changed: bool = False  # since the edit was made

    def over(self, below: Bytes, box: Box) -> Bytes:
        """The edit on top of a part of an image."""
        tone = self.tone if isinstance(self.tone, int) else self.tone[box]
        if self.coverage is None:
            return np.array(np.broadcast_to(np.uint8(tone), below.shape))
        change = np.subtract(tone, below, dtype=np.int32) * self.coverage[box]
        return (below + np.rint(change / 255).astype(np.int32)).astype(np.uint8)


class Canvas:
    """A painted shadow. Several people may paint at once: undoing one stroke leaves the others as they are.

    The canvas keeps the image after each edit. A stroke draws only the rectangle that it touches, and undoing an edit draws
    nothing. This takes H W bytes for each edit, 3.3 MB for 50 edits of 256 x 256 pixels.

    Not thread-safe.

    Args:
        start: visibility (H, W), 0 (dark) to 1 (lit), top row first: the image before the first edit.
        version: number of that image.

    Attributes:
        version: grows with every change.
    """

    def __init__(self, start: npt.ArrayLike, version: int = 0) -> None:
        self._start = _bytes(start)
        self._base = self._start
        self._edits: list[_Edit] = []
        self._images: list[Bytes] = []  # after each edit
        self._undone: list[_Edit] = []
        self._numbers = itertools.count(1)
        self.version = version

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
        """(H, W), 0 (dark) to 255 (lit), not writable. The next stroke may change it: copy it to keep it."""
        view = self._newest.view()
        view.flags.writeable = False
        return view

    def target(self) -> Array:
        """(H, W), visibility from 0 to 1, a copy."""
        return np.divide(self._newest, 255, dtype=np.float32)

    def stroke(self, key: Hashable, mode: Mode, radius: float, points: npt.ArrayLike) -> int | None:
        """Paint along a line, round, with an edge one pixel soft. A stroke does not get darker where it crosses itself.

        Args:
            key: names the stroke. Further calls with the same key extend the stroke, and are undone with it.
            mode: ``add`` or ``erase`` shadow.
            radius: in pixels.
            points: (N, 2), x to the right and y down from the top left corner, in pixels.

        Returns the number of the edit if the call has begun a new one, else None.
        """
        line = np.asarray(points, np.float64).reshape(-1, 2)
        if mode not in ("add", "erase"):
            raise ShadowmapError(f"a stroke to {mode!r}: choose add or erase.")
        if not (0 < radius < np.inf and len(line) and np.isfinite(line).all()):
            raise ShadowmapError(f"a stroke of {len(line)} points and radius {radius}: give finite ones, at least one point.")
        known = ((k, edit.coverage) for k, edit in enumerate(self._edits) if edit.key == key and edit.coverage is not None)
        index, coverage = next(known, (None, None))
        begun = None
        if index is None or coverage is None:
            coverage = np.zeros(self.shape, np.uint8)
            begun = next(self._numbers)
            self._push(_Edit(begun, key, 0 if mode == "add" else 255, coverage), self._newest.copy())
            index = len(self._edits) - 1
        box = brush.cover(coverage, line, radius)
        if box is not None:
            self._draw(index, box)
        self._undone.clear()
        self.version += 1
        return begun

    def replace(self, image: npt.ArrayLike) -> int:
        """Put an image (H, W) on top of everything. It can be undone. Returns the number of the edit."""
        pixels = _bytes(image, self.shape)
        number = next(self._numbers)
        self._push(_Edit(number, None, pixels, None), pixels.copy())
        self._undone.clear()
        self.version += 1
        return number

    def clear(self) -> int:
        """Put the first image on top of everything. It can be undone. Returns the number of the edit."""
        return self.replace(self._start.astype(np.float32) / 255)

    def undo(self) -> Change | None:
        """Remove the newest edit. None if there is none left in the history."""
        if not self._edits:
            return None
        edit = self._edits.pop()
        self._images.pop()
        self._undone.append(edit)
        self.version += 1
        return Change(edit.number, not edit.below_changed)

    def redo(self) -> Change | None:
        """Put the edit back that was undone last. None if nothing was undone, or something has been painted since."""
        if not self._undone:
            return None
        edit = self._undone.pop()
        edit.below_changed = False
        self._push(edit, edit.over(self._newest, _ALL))
        self.version += 1
        return Change(edit.number, True)

    @property
    def _newest(self) -> Bytes:
        return self._images[-1] if self._images else self._base

    def _push(self, edit: _Edit, image: Bytes) -> None:
        """Add an edit and the image after it. The oldest edit becomes part of the base once there are more than `HISTORY`."""
        self._edits.append(edit)
        self._images.append(image)
        if len(self._edits) > HISTORY:
            self._edits.pop(0)
            self._base = self._images.pop(0)

    def _draw(self, index: int, box: Box) -> None:
        """Draw a rectangle of an edit again, and of all edits on top of it."""
        below = self._images[index - 1] if index else self._base
        for k in range(index, len(self._edits)):
            edit, image = self._edits[k], self._images[k]
            image[box] = edit.over(below[box], box)
            edit.below_changed |= k > index
            below = image


def _bytes(image: npt.ArrayLike, shape: tuple[int, int] | None = None) -> Bytes:
    pixels = np.asarray(image, np.float32)
    if pixels.ndim != 2 or (shape is not None and pixels.shape != shape) or not np.isfinite(pixels).all():
        raise ShadowmapError(f"an image of shape {pixels.shape} to paint on: give finite numbers (H, W), always the same.")
    return np.rint(255 * pixels.clip(0, 1)).astype(np.uint8)

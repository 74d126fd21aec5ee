"""Watching an image file that somebody edits in a paint program."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError
from .exports import MOST_BYTES, read_shadow

_Stamp = tuple[int, int, int]


class ImageWatch:
    """Reads an image file whenever it has changed and is complete.

    Paint programs save in many ways: over the old file, piece by piece, or beside it and then in its place. So a file is only
    read once it has stayed the same between two looks, and only taken when it decodes to its end and has not changed meanwhile.
    Everything else is waited out.

    Args:
        path: the file.
        size: (H, W) of the shadow; images of other sizes are scaled.

    Attributes:
        problem: why the file cannot be used as it is now, None if it can.
    """

    def __init__(self, path: Path, size: tuple[int, int]) -> None:
        self._path, self._size = path, size
        self._seen: _Stamp | None = None
        self._taken: _Stamp | None = None
        self.problem: str | None = None

    def ignore(self) -> None:
        """The file as it is now is no news: we have written it ourselves."""
        self._taken = self._seen = self._stamp()

    def poll(self) -> npt.NDArray[np.float32] | None:
        """Visibility (H, W), 0 (dark) to 1 (lit), if there is something new, else None. Nothing in the file raises an error."""
        stamp = self._stamp()
        if stamp is None:
            self.problem = f"{self._path} is missing."
            return None
        if stamp == self._taken:
            self.problem = None
            return None
        if stamp != self._seen:
            self._seen = stamp
            return None
        try:
            if stamp[1] > MOST_BYTES:
                raise ShadowmapError(f"it has {stamp[1]} bytes, {MOST_BYTES} are allowed.")
            image = read_shadow(self._path.read_bytes(), self._size)
        except (ShadowmapError, OSError) as error:
            self.problem = f"{self._path} cannot be used yet: {error}"
            return None
        if self._stamp() != stamp:
            return None
        self._taken, self.problem = stamp, None
        return image

    def _stamp(self) -> _Stamp | None:
        try:
            status = self._path.stat()
        except OSError:
            return None
        return status.st_mtime_ns, status.st_size, status.st_ino

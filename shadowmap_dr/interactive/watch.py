"""Watches an image file that the user edits in a paint program."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError
from .exports import MOST_BYTES, read_shadow

_Stamp = tuple[int, int, int]


class ImageWatch:
    """Reads an image file whenever it has changed and is complete.

    Some paint programs overwrite the old file piece by piece, others write a new file and move it into place. So the file is read
    only after it has stayed the same for two polls, and used only if it can be decoded to its end and has not changed meanwhile.
    Otherwise the next polls try again.

    Args:
        path: the file.
        size: (H, W) of the shadow. Images of other sizes are scaled.

    Attributes:
        problem: reason why the file cannot be used now, None if it can.
    """

    def __init__(self, path: Path, size: tuple[int, int]) -> None:
        self._path, self._size = path, size
        self._seen: _Stamp | None = None
        self._taken: _Stamp | None = None
        self.problem: str | None = None

    def ignore(self) -> None:
        """Do not read the file until it changes again. Call it after writing the file."""
        self._taken = self._seen = self._stamp()

    def poll(self) -> npt.NDArray[np.float32] | None:
        """Visibility (H, W), 0 (dark) to 1 (lit), of a changed file, else None. Files that cannot be used raise no error."""
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

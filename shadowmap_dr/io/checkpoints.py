"""Checkpoints of runs: archives of arrays, each with a digest. A run goes on from arrays as they were written, or not at all."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError
from .files import atomic, read_arrays

_FINGERPRINT, _CHECKS = "fingerprint", "checks"


def write_checkpoint(path: Path, fingerprint: str, arrays: Mapping[str, npt.ArrayLike]) -> None:
    """Write arrays by name. ``fingerprint``: text that identifies the run."""
    values = {name: np.asarray(array) for name, array in arrays.items()}
    checks = json.dumps({name: _digest(array) for name, array in values.items()})
    with atomic(path) as temporary, temporary.open("wb") as file:
        # Any: NumPy's stubs take named arrays for its own option
        named: dict[str, Any] = {_FINGERPRINT: np.array(fingerprint), _CHECKS: np.array(checks), **values}
        np.savez(file, **named)


def read_checkpoint(path: Path, fingerprint: str) -> dict[str, npt.NDArray[Any]]:
    """Read the arrays of a checkpoint.

    Raises ShadowmapError if the file cannot be read, arrays differ from those that were written, or the run was another one.
    """
    try:
        arrays = read_arrays(path, compressed=False)
        found, checks = str(arrays.pop(_FINGERPRINT)), json.loads(str(arrays.pop(_CHECKS)))
        if any(checks.get(name) != _digest(array) for name, array in arrays.items()):
            raise ValueError("edited")
    except (ShadowmapError, ValueError, KeyError, AttributeError, RecursionError) as error:
        raise unreadable(path) from error
    if found != fingerprint:
        raise ShadowmapError(f"the checkpoint {path} belongs to a run with other settings: delete it or choose another folder.")
    return arrays


def unreadable(path: Path) -> ShadowmapError:
    """An error for a checkpoint that no run can go on from."""
    return ShadowmapError(f"cannot read the checkpoint {path}: it was edited or is damaged; delete it to start this run anew.")


def _digest(array: npt.NDArray[Any]) -> str:
    content = hashlib.sha256(f"{array.dtype.str} {array.shape} ".encode())
    content.update(np.ascontiguousarray(array).tobytes())
    return content.hexdigest()[:16]

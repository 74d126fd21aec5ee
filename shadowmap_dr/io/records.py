"""Records of experiments as JSON."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ShadowmapError
from .files import atomic


def write_json(path: str | os.PathLike[str], value: object) -> None:
    """Write `value` (dicts, sequences, NumPy arrays and scalars; numbers that are not finite become null)."""
    text = json.dumps(plain(value), indent=1, allow_nan=False)
    with atomic(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def read_json(path: str | os.PathLike[str]) -> Any:  # Any: JSON
    """The content of a JSON file. Raises a ShadowmapError that names the file if it cannot be read."""
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ShadowmapError(f"no file {str(path)!r}.") from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ShadowmapError(f"cannot read {path}: {' '.join(str(error).split())}.") from error


def read_record(path: str | os.PathLike[str], settings: Mapping[str, Any], *parts: str) -> dict[str, Any]:
    """The record of an earlier run, to be continued: a mapping with these ``settings``, and one mapping for each of ``parts``.

    Raises ShadowmapError if the file holds no such record, or a record of other settings.
    """
    record, advice = read_json(path), "choose another folder, or leave out --resume"
    if not isinstance(record, dict) or not all(isinstance(record.get(part), dict) for part in ("settings", *parts)):
        raise ShadowmapError(f"{path} is no record of this experiment: {advice}.")
    found = {key: record["settings"].get(key) for key in settings}
    if found != plain(settings):
        raise ShadowmapError(f"{path} belongs to a run with other settings, {found}: {advice}.")
    return record


def plain(value: object) -> Any:  # Any: JSON
    """`value` as JSON can hold it: NumPy values become numbers and lists, numbers that are not finite become None."""
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    if value is None or isinstance(value, (str, int, bool)):
        return value
    raise TypeError(f"{type(value).__name__} is no JSON value")

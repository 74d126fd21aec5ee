"""Records of experiments as JSON."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import os
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import OutputError, ShadowmapError, warn
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
    except (OSError, ValueError, RecursionError) as error:
        raise ShadowmapError(f"cannot read {path}: {' '.join(str(error).split())}.") from error


def digest(value: Any) -> str:  # Any: JSON
    """Short hash of a JSON value, which tells whether a stored one has been edited."""
    return hashlib.sha256(json.dumps(plain(value), sort_keys=True).encode()).hexdigest()[:12]


def digest_of(*arrays: npt.NDArray[Any]) -> str:
    """Short hash of the contents, shapes and types of arrays."""
    found = hashlib.sha256()
    for array in arrays:
        found.update(f"{array.shape} {array.dtype}".encode() + np.ascontiguousarray(array).tobytes())
    return found.hexdigest()[:12]


def write_record(path: str | os.PathLike[str], record: Mapping[str, Any], *parts: str) -> None:
    """Write a record that `read_record` goes on with, with a digest of each entry of its mappings ``parts``."""
    checks = {part: {key: digest(entry) for key, entry in record[part].items()} for part in parts}
    write_json(path, {**record, "checks": checks})


def read_record(
    path: str | os.PathLike[str],
    fresh: Mapping[str, Any],
    parts: Mapping[str, Collection[str]],
    report: Callable[[dict[str, Any]], object] | None = None,
) -> dict[str, Any]:
    """A record to go on with: ``fresh``, and the entries of an earlier call in the file.

    Entries that were edited or damaged are left out, to be made again, and a file that holds no record is set aside. A warning
    says so.

    Args:
        path: the file.
        fresh: record without entries, with ``settings``.
        parts: names of the mappings of entries; keys that entries without digests need, which earlier versions wrote.
        report: makes reports of a record. Entries without digests of which none can be made are damaged.

    Raises ShadowmapError if the file is a record of other settings.
    """
    try:
        record = read_json(path)
    except ShadowmapError:
        record = None
    if not isinstance(record, dict) or not all(isinstance(record.get(part), dict) for part in ("settings", *parts)):
        set_aside(path)
        return dict(fresh)
    settings = plain(fresh["settings"])
    found = {key: record["settings"].get(key) for key in settings}
    if found != settings:
        raise ShadowmapError(
            f"{path} belongs to a run with other settings, {found}: choose another folder, or leave out --resume."
        )
    checks, result = record.get("checks"), dict(fresh)
    for part, needed in parts.items():
        entries = record[part]
        own = checks.get(part) if isinstance(checks, dict) else {}
        own = own if isinstance(own, dict) else {}
        result[part] = {
            key: entry
            for key, entry in entries.items()
            if (
                own.get(key) == digest(entry)
                if checks is not None
                else isinstance(entry, dict)
                and entry.keys() >= set(needed)
                and _is_readable({**fresh, part: {key: entry}}, report)
            )
        }
        lost = len(entries) - len(result[part])
        if lost:
            warn(f"{path}: {lost} of {len(entries)} entries of {part!r} were edited or are damaged: they are made again.")
    return result


def _is_readable(record: dict[str, Any], report: Callable[[dict[str, Any]], object] | None) -> bool:
    """True if a report can be made of a record."""
    if report is not None:
        try:
            report(record)
        except (KeyError, IndexError, TypeError, ValueError, AttributeError, ArithmeticError, ShadowmapError):
            return False
    return True


def set_aside(path: str | os.PathLike[str]) -> None:
    """Give a file that is no record of an experiment another name, and say so in a warning: nothing is lost."""
    path = Path(path)
    names = (path.with_name(f"{path.name}.{k}.bak") for k in itertools.count(1))
    other = next(name for name in names if not name.exists())
    try:
        path.replace(other)
    except OSError as error:
        raise OutputError(f"{path} is no record of this experiment, and cannot be renamed: {error.strerror or error}.") from error
    warn(f"{path} is no record of this experiment, or is damaged: it is now {other.name}, and all runs are made again.")


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

"""Files that appear under their name only when they are complete, and archives of arrays."""

from __future__ import annotations

import errno
import hashlib
import os
import platform
import re
import tempfile
import zipfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import OutputError, ShadowmapError

SUFFIXES = (".exr", ".png")
# Names of temporary files: machine, process, and what `tempfile` adds. Folders that were searched for those of killed processes.
_HOST = hashlib.sha256(platform.node().encode()).hexdigest()[:8]
_TEMPORARY = re.compile(r"\..*-(?P<host>[0-9a-f]{8})-(?P<process>[0-9]{1,9})-[a-z0-9_]{8}(\.[^.]*)?", re.DOTALL)
_CLEARED: set[Path] = set()
#: Most bytes of the arrays of an archive that is read.
MOST_DECODED = 8_000_000_000


@contextmanager
def atomic(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary file beside `path` that replaces it when the block succeeds, and is deleted when the block fails.

    Parent directories are created. Raises OutputError if the file cannot be written (no permission, full disk).
    """
    path = Path(path)
    temporary: Path | None = None
    try:
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, "Is a directory")
        _make_folder(path.parent)
        remove_leftovers(path.parent)
        handle, name = tempfile.mkstemp(prefix=f".{path.stem}-{_HOST}-{os.getpid()}-", suffix=path.suffix, dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        yield temporary
        temporary.chmod(0o666 & ~_umask())  # mkstemp makes files that nobody else may read
        os.replace(temporary, path)
        temporary = None
    except OutputError:
        raise
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror or error}.") from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def make_folder(folder: Path) -> None:
    """Create a folder and its parents. Raises OutputError if that is not allowed, or if one of them is a file."""
    try:
        _make_folder(folder)
    except OSError as error:
        raise OutputError(f"cannot write into {folder}: {error.strerror or error}; give another folder.") from error


def _make_folder(folder: Path) -> None:
    """Create a folder and its parents; raises an OSError that names a parent which is a file."""
    for path in (folder, *folder.parents):
        if path.exists() and not path.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, f"{path} is a file")
    folder.mkdir(parents=True, exist_ok=True)


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files of `atomic` that killed processes of this machine have left; once a process and folder."""
    folder = folder.resolve()
    if folder in _CLEARED:
        return
    _CLEARED.add(folder)
    for path in folder.iterdir():
        found = _TEMPORARY.fullmatch(path.name)
        if found and found["host"] == _HOST and not _is_running(int(found["process"])):
            path.unlink(missing_ok=True)


def _is_running(process: int) -> bool:
    if os.name != "posix":
        return True  # signal 0 asks here, but ends processes on Windows
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


def check_output(path: str | os.PathLike[str], suffixes: tuple[str, ...] = SUFFIXES) -> Path:
    """Check, before any work is done, that `path` can be written later. Returns it as a Path, or raises OutputError."""
    path = Path(path)
    check_name(path)
    if path.suffix.lower() not in suffixes:
        raise OutputError(f"cannot write {path}: the suffix {path.suffix!r} is not one of {', '.join(suffixes)}.")
    try:
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, "Is a directory")
        if path.exists() and not os.access(path, os.W_OK):
            raise PermissionError(errno.EACCES, "Permission denied")
        _make_folder(path.parent)
        remove_leftovers(path.parent)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror or error}.") from error
    return path


def check_readable(path: Path) -> None:
    """ShadowmapError if a file does not exist, or if libraries cannot be told its name: names may be of any bytes."""
    check_name(path)
    if not os.path.isfile(path):
        raise no_file("file", path)


def no_file(kind: str, path: str | os.PathLike[str]) -> ShadowmapError:
    """An error about a name that is no file's: there is none, or it is a folder's. ``kind``: noun, such as ``image``."""
    reason = "it is a folder; give a file" if os.path.isdir(path) else "the file does not exist"
    return ShadowmapError(f"no {kind} {os.fspath(path)!r}: {reason}.")


def check_name(path: str | os.PathLike[str]) -> None:
    """OutputError if a name is not UTF-8: Mitsuba, OpenEXR and JSON cannot hold it."""
    try:
        os.fspath(path).encode("utf-8")
    except UnicodeEncodeError:
        raise OutputError(f"the name {os.fspath(path)!r} is not UTF-8: choose another, or rename the file.") from None


def read_arrays(
    path: str | os.PathLike[str], only: Collection[str] | None = None, *, compressed: bool = True
) -> dict[str, npt.NDArray[Any]]:
    """The arrays of an .npz file by name.

    Args:
        path: the file.
        only: names of the arrays that are read; None for all.
        compressed: False for files whose arrays take no more bytes than they do.

    Raises ShadowmapError if it cannot be read.
    """
    try:
        if not os.path.isfile(path) or not zipfile.is_zipfile(path):  # NumPy would call other files pickled objects
            raise ValueError("no archive")
        with zipfile.ZipFile(path) as archive:
            sizes = {entry.filename.removesuffix(".npy"): entry.file_size for entry in archive.infolist()}
        decoded = sum(size for name, size in sizes.items() if only is None or name in only)
        most = MOST_DECODED if compressed else min(MOST_DECODED, os.path.getsize(path))
        if decoded > most:
            raise ShadowmapError(
                f"cannot read {path}: its arrays take {decoded / 1e6:.0f} MB, more than {most / 1e6:.0f} MB: give smaller ones."
            )
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files if only is None or name in only}
    except ShadowmapError:
        raise
    except Exception as error:  # NumPy and the decompressor raise errors of many kinds for damaged files
        reason = "objects are not read" if "pickle" in str(error) else "it is no .npz file, or it is damaged"
        raise ShadowmapError(f"cannot read {path}: {reason}; give an .npz file of plain arrays.") from error


def _umask() -> int:
    mask = os.umask(0o022)
    os.umask(mask)
    return mask

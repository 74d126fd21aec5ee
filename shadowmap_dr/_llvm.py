"""Finds an LLVM library that Dr.Jit 1.5 can compile with.

Dr.Jit loads the first ``libLLVM`` it finds while ``import drjit`` runs, and keeps it. With LLVM 15 or 16 its kernels
later end the whole process (``Cannot select: fminimum``) without a Python exception. So this module points Dr.Jit to a
good library before the first import. For scripts that import mitsuba or drjit before shadowmap_dr, the file
`_llvm.pth`, which an installation places beside the packages, does the same at the start of the interpreter.
"""

from __future__ import annotations

import ctypes
import glob
import os
import re
import sys
import sysconfig
import warnings
from pathlib import Path

from .errors import LLVMError

MIN_VERSION = 17
ENVIRONMENT_VARIABLE = "DRJIT_LIBLLVM_PATH"
WHEEL = "karellen-llvm-core"

# The C++ runtime of the wheel's libLLVM, in the order in which the parts depend on each other.
_RUNTIME = ("libunwind.so.1", "libc++abi.so.1", "libc++.so.1")
_RUNTIME_FOLDER = "x86_64-unknown-linux-gnu"
_SYSTEM_PATTERNS = (
    "/usr/lib/*-linux-gnu/libLLVM*.so*",
    "/usr/lib64/libLLVM*.so*",
    "/usr/lib/libLLVM*.so*",
    "/usr/lib/llvm-*/lib/libLLVM*.so*",
    "/usr/lib64/llvm*/lib*/libLLVM*.so*",
    "/opt/homebrew/opt/llvm*/lib/libLLVM*.dylib",
    "/usr/local/opt/llvm*/lib/libLLVM*.dylib",
)


def ensure() -> None:
    """Make sure that Dr.Jit uses LLVM >= 17 (or a GPU where there is no LLVM at all).

    Raises LLVMError if neither is available. Imports drjit.
    """
    imported_before = "drjit" in sys.modules
    if not imported_before:
        _choose()
    import drjit as dr

    version = loaded_version()
    if version is not None and version[0] >= MIN_VERSION:
        return
    found = f"LLVM {'.'.join(map(str, version))}, with which kernels end the process" if version else "no LLVM library"
    if dr.has_backend(dr.JitBackend.CUDA):
        if version is not None:
            warnings.warn(f"Dr.Jit loaded {found}: use only cuda variants, or {_remedy()}.", stacklevel=3)
        return
    if imported_before and find() is not None:
        raise LLVMError(f"Dr.Jit was imported first and found {found}: import shadowmap_dr before mitsuba and drjit.")
    named = os.environ.get(ENVIRONMENT_VARIABLE)
    fault = f" ({named} {_named_fault(named)})" if named and version is None else ""
    raise LLVMError(f"Dr.Jit found {found}{fault}: {_remedy()}.")


def find() -> Path | None:
    """The best LLVM library on this machine with version >= 17, or None. Dr.Jit need not be imported."""
    bundled = _wheel_library()
    if bundled is not None:
        return bundled
    system = {Path(p).resolve() for pattern in _SYSTEM_PATTERNS for p in glob.glob(pattern)}
    usable = [(_file_version(path), str(path)) for path in system]
    usable = [entry for entry in usable if entry[0] >= MIN_VERSION and _is_library(Path(entry[1]))]
    return Path(max(usable)[1]) if usable else None


def loaded_version() -> tuple[int, int, int] | None:
    """Version of the LLVM library that Dr.Jit uses, None if it has none. Imports drjit."""
    import drjit as dr

    if not dr.has_backend(dr.JitBackend.LLVM):
        return None
    return tuple(dr.detail.llvm_version())


def loaded_library() -> str | None:
    """Path of the LLVM library in use: on Linux from the process's memory map, elsewhere the environment variable's value."""
    named = os.environ.get(ENVIRONMENT_VARIABLE)
    try:
        mapped = {line.split()[-1] for line in Path("/proc/self/maps").read_text().splitlines() if "libLLVM" in line}
    except OSError:
        return named
    if named and str(Path(named).resolve()) in mapped:
        return str(Path(named).resolve())
    return min(mapped) if mapped else None


def _wheel_library() -> Path | None:
    for folder in dict.fromkeys((sysconfig.get_path("data"), sys.prefix, sys.base_prefix)):
        for path in sorted(Path(folder, "lib").glob("libLLVM.so.*")):
            if (path.parent / _RUNTIME_FOLDER).is_dir() and _file_version(path) >= MIN_VERSION and _is_library(path):
                return path
    # `pip install --user` and `--target` put the library elsewhere; the wheel's own file list knows where.
    import importlib.metadata  # slow, and seldom needed

    try:
        files = importlib.metadata.distribution(WHEEL).files or ()
    except importlib.metadata.PackageNotFoundError:
        return None
    for entry in files:
        if entry.name.startswith("libLLVM.so."):
            path = Path(str(entry.locate())).resolve()
            if path.is_file() and _is_library(path):
                return path
    return None


def _file_version(path: Path) -> int:
    """Major version by file name (libLLVM-15.so, libLLVM.so.19.1, libLLVM-14.0.6.so.1), folder name or the library, else 0."""
    match = re.search(r"libLLVM-(\d+)|libLLVM\.so\.(\d\d+)|libLLVM\.(\d+)\.dylib", path.name)
    if match is None:
        match = re.search(r"llvm-?@?(\d+)", str(path.parent))
    if match is not None:
        return int(next(group for group in match.groups() if group))
    try:
        numbers = (ctypes.c_uint * 3)()
        library = ctypes.CDLL(str(path))
        library.LLVMGetVersion(*(ctypes.byref(numbers, 4 * i) for i in range(3)))
        return int(numbers[0])
    except (OSError, AttributeError):
        return 0


def _choose() -> None:
    """Set the environment variable that Dr.Jit reads, unless it names a usable library already."""
    named = os.environ.get(ENVIRONMENT_VARIABLE)
    reason = _named_fault(named) if named else ""
    if named and not reason:
        return
    path = find()
    if path is None:
        return
    if named:
        warnings.warn(f"{ENVIRONMENT_VARIABLE}={named} {reason}: using {path}.", stacklevel=4)
    _load_runtime(path)
    os.environ[ENVIRONMENT_VARIABLE] = str(path)


def _named_fault(named: str) -> str:
    """The fault of the library that the environment names, empty if it is usable."""
    path = Path(named)
    if not path.is_file() or _file_version(path) < MIN_VERSION:
        return f"is not LLVM {MIN_VERSION} or newer"
    _load_runtime(path)
    return _load_fault(path)


def _load_fault(path: Path) -> str:
    """The reason why a file named like an LLVM library is none, empty if it is one. Loads it, as Dr.Jit does afterwards."""
    if not _is_library(path):
        return "is named like an LLVM library, but is no shared library"
    try:
        ctypes.CDLL(str(path)).LLVMGetVersion  # noqa: B018
    except OSError as error:
        return f"is named like an LLVM library, but cannot be loaded ({error})"
    except AttributeError:
        return "is named like an LLVM library, but is another one"
    return ""


def _is_library(path: Path) -> bool:
    """True if a file begins like a shared library (ELF, Mach-O, or several of the latter)."""
    try:
        with path.open("rb") as file:
            return file.read(4) in (b"\x7fELF", b"\xcf\xfa\xed\xfe", b"\xca\xfe\xba\xbe")
    except OSError:
        return False


def _load_runtime(path: Path) -> None:
    """Load the C++ runtime of the wheel's library where its links are missing.

    The wheel creates the link libc++.so.1 at the first interpreter start. Where the environment cannot be written to, the link is
    missing, and the runtime is loaded beforehand under its own name.
    """
    folder = path.parent / _RUNTIME_FOLDER
    if folder.is_dir() and not all((folder / name).exists() for name in _RUNTIME):
        for name in _RUNTIME:
            for candidate in sorted(folder.glob(name + "*"))[:1]:
                ctypes.CDLL(str(candidate), mode=ctypes.RTLD_GLOBAL)


def _remedy() -> str:
    if sys.platform == "linux" and os.uname().machine == "x86_64":
        return f"install LLVM {MIN_VERSION} or newer with: pip install {WHEEL}"
    return f"install LLVM {MIN_VERSION} or newer (Debian: libllvm19), or name it in {ENVIRONMENT_VARIABLE}"

"""Importing this imports shadowmap_dr, and Dr.Jit with it, for kernels that compile quickly. To be imported before Dr.Jit.

Kernels of tests are compiled without LLVM's optional passes: thousands of kernels that run once each, in 40 % of the time.

What is tested is the code that Dr.Jit is given, which is the same. Processes that tests start (the command line, examples,
tutorials) compile as users' do, and so do all with ``SHADOWMAP_TESTS_OPTIMIZE=1`` in the environment.
"""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

_SWITCH = "SHADOWMAP_TESTS_OPTIMIZE"
_FOLDER = "DRJIT_CACHE_DIR"
# Options of LLVM's own tools, which the library has, too. The second one keeps it from naming each pass that it leaves out.
_OPTIONS = (b"-opt-bisect-limit=0", b"-opt-bisect-verbose=false")


def _leave_out_passes() -> None:
    # Dr.Jit finds kernels again by what they compute, however they were compiled: those of users are to stay quick to run.
    kept = os.environ.get(_FOLDER)
    folder = Path(__file__).parent.parent / ".pytest_cache" / "kernels"
    folder.mkdir(parents=True, exist_ok=True)
    os.environ[_FOLDER] = str(folder)
    from shadowmap_dr import _llvm

    library = _llvm.loaded_library()
    if library is not None and _llvm.loaded_version() is not None:
        arguments = (ctypes.c_char_p * (1 + len(_OPTIONS)))(b"tests", *_OPTIONS)
        ctypes.CDLL(library).LLVMParseCommandLineOptions(len(arguments), arguments, b"")
    # Processes that tests start are not to find them.
    if kept is None:
        del os.environ[_FOLDER]
    else:
        os.environ[_FOLDER] = kept


if os.environ.get(_SWITCH, "0") == "0":
    _leave_out_passes()
else:
    import shadowmap_dr  # noqa: F401

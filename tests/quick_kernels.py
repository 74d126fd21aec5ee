"""Importing this imports shadowmap_dr, and Dr.Jit with it, for kernels that compile quickly. To be imported before Dr.Jit.

Kernels of tests are compiled without LLVM's optional passes: thousands of kernels that run once each, in 40 % of the time. What
is tested is the code that Dr.Jit is given, which is the same. Processes that tests start (the command line, examples,
tutorials) compile as users' do what no test has compiled yet; so do all tests with ``SHADOWMAP_TESTS_OPTIMIZE=1``.
"""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

#: Dr.Jit finds kernels again by what they compute, however they were compiled: those of users are to stay quick to run.
FOLDER = Path(__file__).parent.parent / ".pytest_cache" / "kernels"
# Options of LLVM's own tools, which the library has, too. The second one keeps it from naming each pass that it leaves out.
_OPTIONS = (b"-opt-bisect-limit=0", b"-opt-bisect-verbose=false")


def _leave_out_passes() -> None:
    FOLDER.mkdir(parents=True, exist_ok=True)
    os.environ["DRJIT_CACHE_DIR"] = str(FOLDER)
    from shadowmap_dr import _llvm

    library = _llvm.loaded_library()
    if library is not None and _llvm.loaded_version() is not None:
        arguments = (ctypes.c_char_p * (1 + len(_OPTIONS)))(b"tests", *_OPTIONS)
        ctypes.CDLL(library).LLVMParseCommandLineOptions(len(arguments), arguments, b"")


if os.environ.get("SHADOWMAP_TESTS_OPTIMIZE", "0") == "0":
    _leave_out_passes()
else:
    import shadowmap_dr  # noqa: F401

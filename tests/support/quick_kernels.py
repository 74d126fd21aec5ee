"""Importing this imports shadowmap_dr, and Dr.Jit with it, for kernels that compile quickly. To be imported before Dr.Jit.

Kernels of tests are compiled without LLVM's optional passes and with its fast register allocator: thousands of kernels that run
once each, in a third of the time. The code that Dr.Jit is given, which is what is tested, is the same. Processes that tests start
(the command line, examples, tutorials) compile as users' do what no test has compiled yet; so do all tests with
``SHADOWMAP_TESTS_OPTIMIZE=1``. With ``pytest -s``, LLVM is seen to name each pass that it leaves out.
"""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

#: Dr.Jit finds kernels again by what they compute, however they were compiled: those of users are to stay quick to run.
FOLDER = Path(__file__).parents[2] / ".pytest_cache" / "kernels"
# Options of LLVM's own tools, which the library has, too.
_OPTIONS = (b"-opt-bisect-limit=0", b"-regalloc=fast", b"-optimize-regalloc=false")


def _leave_out_passes() -> None:
    FOLDER.mkdir(parents=True, exist_ok=True)
    os.environ["DRJIT_CACHE_DIR"] = str(FOLDER)
    from shadowmap_dr import _llvm

    library = _llvm.loaded_library()
    if library is not None and _llvm.loaded_version() is not None:
        arguments = (ctypes.c_char_p * (1 + len(_OPTIONS)))(b"tests", *_OPTIONS)
        ctypes.CDLL(library).LLVMParseCommandLineOptions(len(arguments), arguments, b"")


def without_messages(output: str) -> str:
    """Output of a test, without LLVM's lines about passes that it leaves out."""
    return "".join(line for line in output.splitlines(keepends=True) if not line.startswith("BISECT: "))


if os.environ.get("SHADOWMAP_TESTS_OPTIMIZE", "0") == "0":
    _leave_out_passes()
else:
    import shadowmap_dr  # noqa: F401

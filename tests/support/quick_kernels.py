"""Importing this imports shadowmap_dr, and Dr.Jit with it, for kernels that compile quickly. To be imported before Dr.Jit.

Kernels of tests are compiled without LLVM's optional passes: thousands of kernels that run a few times each. The register
allocator is the usual one: with the fast one kernels are compiled sooner but run longer (seven groups of tests: 317 s of
processor time, 301 with the usual one). The code that Dr.Jit is given, which is what is tested, is the same. Processes that tests
start (the command line, examples, tutorials) compile as users' do what no test has compiled yet; so do all tests with
``SHADOWMAP_TESTS_OPTIMIZE=1``. With ``pytest -s``, LLVM is seen to name each pass that it leaves out: hundreds for each kernel,
word by word, which took a tenth of the time of compiling. They are buffered, and written at the end of each phase of a test.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

#: Dr.Jit finds kernels again by what they compute, however they were compiled: those of users are to stay quick to run.
FOLDER = Path(__file__).parents[2] / ".pytest_cache" / "kernels"
# An option of LLVM's own tools, which the library has, too.
_OPTION = b"-opt-bisect-limit=0"
# LLVM's stream of errors, and two methods of it. C has no names for them.
_STREAM, _BUFFER, _FLUSH = "_ZN4llvm4errsEv", "_ZN4llvm11raw_ostream11SetBufferedEv", "_ZN4llvm11raw_ostream14flush_nonemptyEv"


def _nothing() -> None:
    pass


#: Writes what LLVM's stream of errors has kept back; does nothing while it keeps nothing back.
flush_messages: Callable[[], None] = _nothing


def _leave_out_passes() -> None:
    FOLDER.mkdir(parents=True, exist_ok=True)
    os.environ["DRJIT_CACHE_DIR"] = str(FOLDER)
    from shadowmap_dr import _llvm

    library = _llvm.loaded_library()
    if library is not None and _llvm.loaded_version() is not None:
        arguments = (ctypes.c_char_p * 2)(b"tests", _OPTION)
        llvm = ctypes.CDLL(library)
        llvm.LLVMParseCommandLineOptions(len(arguments), arguments, b"")
        if all(hasattr(llvm, name) for name in (_STREAM, _BUFFER, _FLUSH)):
            _buffer_messages(llvm)


def _buffer_messages(llvm: ctypes.CDLL) -> None:
    global flush_messages
    getattr(llvm, _STREAM).restype = ctypes.c_void_p
    stream = ctypes.c_void_p(getattr(llvm, _STREAM)())
    getattr(llvm, _BUFFER)(stream)
    flush_messages = partial(getattr(llvm, _FLUSH), stream)


def without_messages(output: str) -> str:
    """Output of a test, without LLVM's lines about passes that it leaves out."""
    return "".join(line for line in output.splitlines(keepends=True) if not line.startswith("BISECT: "))


if os.environ.get("SHADOWMAP_TESTS_OPTIMIZE", "0") == "0":
    _leave_out_passes()
else:
    import shadowmap_dr  # noqa: F401

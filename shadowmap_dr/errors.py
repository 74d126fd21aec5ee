"""Errors that the library raises on purpose.

Every message is one line: what is wrong, the offending value, and what to do about it.
"""

from __future__ import annotations


class ShadowmapError(ValueError):
    """Bad input to shadowmap_dr: a scene, an option or an array that cannot be used as given."""


class UnsupportedShape(ShadowmapError):
    """A shape that cannot be rendered, but that a scene can be rendered without."""


class LLVMError(ShadowmapError, ImportError):
    """No LLVM library that Dr.Jit can compile with."""


class OutputError(ShadowmapError, OSError):
    """A result could not be written (unwritable directory, full disk, unknown suffix)."""


def is_interrupt(error: BaseException | None) -> bool:
    """Whether an error is Ctrl-C, or what Dr.Jit makes of it where it comes while a recorded function is replayed."""
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return True
        error = error.__cause__ or error.__context__
    return False

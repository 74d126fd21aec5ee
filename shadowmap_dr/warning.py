"""Warnings that point to the user's own code."""

from __future__ import annotations

import inspect
import warnings

# Packages whose own code a warning does not point to.
_CALLED = ("shadowmap_dr", "mitsuba", "drjit")


def warn(message: str) -> None:
    """A ``UserWarning`` that points to who called this package or Mitsuba."""
    level, frame = 1, inspect.currentframe()
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] in _CALLED:
        level, frame = level + 1, frame.f_back
    warnings.warn(message, stacklevel=level)

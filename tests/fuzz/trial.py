"""Trials of cases: what they raise and warn of, judged."""

from __future__ import annotations

import linecache
import os
import sys
import time
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path

import shadowmap_dr
from shadowmap_dr.errors import ShadowmapError

from .outcome import FAULT, REFUSED, RESULT, Outcome, Refused, Wrong

_PACKAGE = str(Path(shadowmap_dr.__file__).parent)
_MOST_LINE = 2000


def outcome_of(run: Callable[[], str]) -> Outcome:
    """Try a case. Warnings must be single lines, and must not come from NumPy's arithmetic in this package."""
    began = time.monotonic()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        kind, text = _tried(run)
    if kind != FAULT:
        for entry in caught:
            message = str(entry.message)
            if issubclass(entry.category, RuntimeWarning) and entry.filename.startswith(_PACKAGE):
                kind, text = FAULT, f"{entry.category.__name__}: {message} ({_place(entry.filename, entry.lineno)})"
            elif issubclass(entry.category, UserWarning) and "\n" in message:
                kind, text = FAULT, f"a warning of several lines: {message!r}"
    return Outcome(kind, text, time.monotonic() - began)


def _tried(run: Callable[[], str]) -> tuple[str, str]:
    try:
        return RESULT, run()
    except Refused as error:
        return _refusal(str(error))
    except Wrong as error:
        return FAULT, f"wrong result: {error}"
    except Exception as error:
        root = _root(error)
        if isinstance(root, ShadowmapError) or (type(root) is ValueError and _is_raised_here(root)):
            return _refusal(str(root))
        print(traceback.format_exc(), file=sys.__stderr__, flush=True)
        return FAULT, f"{type(root).__name__}: {' '.join(str(root).split())[:300]} ({_last_place(root)})"


def _refusal(message: str) -> tuple[str, str]:
    if not message.strip() or "\n" in message or len(message) > _MOST_LINE:
        return FAULT, f"a refusal of several lines, none, or a very long one: {message[:300]!r}"
    return REFUSED, message


def _root(error: BaseException) -> BaseException:
    """The exception that a group of tasks or Dr.Jit has wrapped."""
    while len(inner := getattr(error, "exceptions", ())) == 1:  # of a group of tasks
        error = inner[0]
    while isinstance(error, RuntimeError) and (cause := error.__cause__ or error.__context__) is not None:
        error = cause
    return error


def _is_raised_here(error: BaseException) -> bool:
    """True if a line of this package raises the error."""
    frames = traceback.extract_tb(error.__traceback__)
    if not frames or not frames[-1].filename.startswith(_PACKAGE):
        return False
    return linecache.getline(frames[-1].filename, frames[-1].lineno or 0).strip().startswith("raise")


def _last_place(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if frame.filename.startswith(_PACKAGE)] or frames
    return _place(own[-1].filename, own[-1].lineno) if own else "?"


def _place(filename: str, line: int | None) -> str:
    return f"{os.path.relpath(filename, os.path.dirname(_PACKAGE))}:{line}"

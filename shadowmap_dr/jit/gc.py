"""Pauses of Python's garbage collector."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def gc_paused() -> Iterator[None]:
    """Pause garbage collection within the block.

    A scene that is freed while Dr.Jit records a function ends the process. One freed between two calls causes a new recording.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


@contextmanager
def gc_quiet() -> Iterator[None]:
    """Collect garbage now, not within the block: collection would be timed, and freed scenes cause new recordings."""
    gc.collect()
    with gc_paused():
        yield

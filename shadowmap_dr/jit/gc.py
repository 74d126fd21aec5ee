"""Keeping Python's garbage collector away from what it disturbs."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def gc_paused() -> Iterator[None]:
    """No garbage collection within.

    Scenes that are freed while Dr.Jit records a function end the process, and those freed between two calls make it record anew.
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
    """No garbage collection within: a pause would be timed, and freeing scenes makes frozen functions record anew."""
    gc.collect()
    with gc_paused():
        yield

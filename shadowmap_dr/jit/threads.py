"""Dr.Jit's number of threads while Mitsuba reads files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import drjit as dr


@contextmanager
def second_thread() -> Iterator[None]:
    """Give Dr.Jit two threads within the block, if it has one.

    Mitsuba 3.9 hands parts of EXR files to Dr.Jit's threads and waits for them. With one thread, the default on one core,
    it waits forever.
    """
    threads = dr.thread_count()
    if threads > 1:
        yield
        return
    dr.set_thread_count(2)
    try:
        yield
    finally:
        dr.set_thread_count(threads)

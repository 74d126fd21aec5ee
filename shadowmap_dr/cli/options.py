"""Options that several commands share."""

from __future__ import annotations

from typing import Annotated, TypeVar

import typer

Variant = Annotated[str, typer.Option(help="Mitsuba variant; the cuda ones need an NVIDIA GPU.")]

Scheduler = Annotated[
    str, typer.Option(metavar="local|processes:N|tcp://HOST:PORT", help="Scheduler of the runs: this process, or workers.")
]
SchedulerThreads = Annotated[int, typer.Option("--threads", help="Threads of each process, 0 for one for each core.")]


_T = TypeVar("_T")


def given(value: _T | None, default: _T) -> _T:
    """An option's value, or the default if it is None. (0 is a value.)"""
    return default if value is None else value

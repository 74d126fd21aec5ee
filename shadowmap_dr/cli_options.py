"""What commands have in common: the options for the Mitsuba variant and for who does the work."""

from __future__ import annotations

from typing import Annotated

import drjit as dr
import mitsuba as mi
import typer

from .errors import ShadowmapError

DEFAULT_VARIANT = "llvm_ad_rgb"

Variant = Annotated[str, typer.Option(help="Mitsuba variant; the cuda ones need an NVIDIA GPU.")]

Scheduler = Annotated[
    str, typer.Option(metavar="local|processes:N|tcp://HOST:PORT", help="Who does the runs: this process or workers.")
]
SchedulerThreads = Annotated[int, typer.Option("--threads", help="Threads of each process, 0 for one for each core.")]


def set_variant(name: str) -> None:
    """Set the Mitsuba variant; ShadowmapError if it does not exist or has no device."""
    if name not in mi.variants():
        raise ShadowmapError(f"no variant {name!r} in this Mitsuba: choose one of {', '.join(mi.variants())}.")
    if name.startswith("cuda") and not dr.has_backend(dr.JitBackend.CUDA):
        raise ShadowmapError(f"the variant {name} needs an NVIDIA GPU, and Dr.Jit found none: use {DEFAULT_VARIANT}.")
    mi.set_variant(name)

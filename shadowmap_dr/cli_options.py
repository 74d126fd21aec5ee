"""What commands have in common: the options for the Mitsuba variant and for who does the work."""

from __future__ import annotations

from typing import Annotated, TypeVar

import drjit as dr
import mitsuba as mi
import typer

from .errors import ShadowmapError

DEFAULT_VARIANT = "llvm_ad_rgb"
#: Endings of variants: those that renderings with shadow maps work in, those with colours, and all.
SUPPORTED, COLOURED, ANY = ("_ad_rgb", "_ad_mono"), ("_ad_rgb",), ("",)

Variant = Annotated[str, typer.Option(help="Mitsuba variant; the cuda ones need an NVIDIA GPU.")]

Scheduler = Annotated[
    str, typer.Option(metavar="local|processes:N|tcp://HOST:PORT", help="Who does the runs: this process or workers.")
]
SchedulerThreads = Annotated[int, typer.Option("--threads", help="Threads of each process, 0 for one for each core.")]


_T = TypeVar("_T")


def given(value: _T | None, default: _T) -> _T:
    """An option's value, or the default where it has not been given: 0 is a value."""
    return default if value is None else value


def set_variant(name: str, endings: tuple[str, ...] = SUPPORTED) -> None:
    """Set the Mitsuba variant.

    ShadowmapError if it does not exist, has no device, or is none that the command works in: only those with the ``endings`` are.
    """
    fitting = [variant for variant in mi.variants() if variant.endswith(endings)]
    if name not in mi.variants():
        raise ShadowmapError(f"no variant {name!r} in this Mitsuba: choose one of {', '.join(fitting)}.")
    if name not in fitting:
        raise ShadowmapError(f"this command does not work in the variant {name}: choose one of {', '.join(fitting)}.")
    if name.startswith("cuda") and not dr.has_backend(dr.JitBackend.CUDA):
        raise ShadowmapError(f"the variant {name} needs an NVIDIA GPU, and Dr.Jit found none: use {DEFAULT_VARIANT}.")
    mi.set_variant(name)

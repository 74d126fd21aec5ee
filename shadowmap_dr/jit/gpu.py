"""Workarounds for operations that Dr.Jit 1.5 cannot do on a GPU. ``docs/dr-jit-faults`` has the proofs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi


def keep_registers() -> None:
    """Let this thread's kernels spill registers to memory of their own, not to memory that threads share.

    Compilers since CUDA 13 refuse kernels that do the latter and call functions, such as BSDFs of several kinds, and Dr.Jit ends
    the process then. Flags are each thread's own. Where there is no GPU this changes nothing.
    """
    dr.set_flag(dr.JitFlag.SpillToSharedMemory, False)


def looked_up(look_up: Callable[[Any, Any], Any], si: Any, active: Any) -> Any:
    """``look_up(si, active)``, which reads textures. Without meaning where not ``active`` (Bool).

    A GPU reads textures without a mask here: masked reads, other than those within calls, end the process while a function is
    recorded.

    Args:
        look_up: given ``mi.SurfaceInteraction3f`` and Bool, returns colours. Attached as it is.
        si: surface interactions (N). Texels are found for whatever is not active, too: all numbers do.
        active: Bool (N).
    """
    if dr.backend_v(mi.Float) != dr.JitBackend.CUDA:
        return look_up(si, active)
    return dr.select(active, look_up(si, mi.Bool(True)), 0)

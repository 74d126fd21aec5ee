"""Workarounds for operations that fail in Dr.Jit 1.5 on a GPU. ``docs/dr-jit-faults`` has scripts that reproduce the faults."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi

from .types import Bool, Color3f


def keep_registers() -> None:
    """Let kernels that this thread launches spill registers to local memory, not to shared memory.

    Since CUDA 13 the compiler refuses kernels that spill to shared memory and call functions (such as BSDFs of several kinds),
    and Dr.Jit then ends the process. Each thread has flags of its own. Without a GPU, the flag has no effect.
    """
    dr.set_flag(dr.JitFlag.SpillToSharedMemory, False)


def looked_up(look_up: Callable[[mi.SurfaceInteraction3f, Bool], Color3f], si: mi.SurfaceInteraction3f, active: Bool) -> Color3f:
    """Colours ``look_up(si, active)`` of textures; undefined in lanes that are not ``active``.

    On a GPU the textures are read without a mask: a masked read outside of a call ends the process while a function is recorded.

    Args:
        look_up: function of surface interactions and a mask that returns colours. Gradients are those of ``look_up``.
        si: surface interactions (N). Inactive lanes are read, too; any coordinates do, for textures wrap or clamp them.
        active: ``Bool`` (N).
    """
    if dr.backend_v(mi.Float) != dr.JitBackend.CUDA:
        return look_up(si, active)
    return dr.select(active, look_up(si, mi.Bool(True)), 0)

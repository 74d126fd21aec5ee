"""Orders for the optimiser's thread: a new target, and commands that keep, restore or reset the mesh."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from .mesh_history import KeptMesh, MeshHistory
from .modeller import Modeller, ModellerState

Kind = Literal["keep", "go back", "reset"]


@dataclass(frozen=True)
class Target:
    """A target image.

    Attributes:
        image: visibility (H, W) from 0 (dark) to 1 (lit).
        version: number of the image.
        follow: False if a mesh that has just gone back to a kept state need not follow the image, since it did so then.
    """

    image: npt.NDArray[np.float32]
    version: int
    follow: bool


@dataclass(frozen=True)
class Command:
    """Keep the mesh under a name, go back to the mesh of a name, or reset the mesh.

    Attributes:
        kind: see above.
        name: of the kept mesh.
        version: of the newest target when the command was given.
    """

    kind: Kind
    name: Hashable = None
    version: int = 0


def execute(modeller: Modeller, history: MeshHistory, commands: Sequence[Command], target: Target | None, known: int) -> bool:
    """Carry out commands, then take the target. Returns True if a command has changed the mesh.

    Args:
        modeller: follows the target of the version `known`.
        history: kept meshes.
        commands: in the order in which they were given.
        target: None if there is no new one.
        known: see above.
    """
    moved = current = False
    now: ModellerState | None = None  # one copy for all commands between two steps
    for command in commands:
        if command.kind == "keep":
            now = now or modeller.state()
            if now.finite:
                history.put(command.name, KeptMesh(now, current=command.version == known))
        elif command.kind == "reset":
            modeller.reset()
            moved, current, now = True, False, None
        else:
            mesh = history.get(command.name)
            current = mesh is not None and mesh.current
            if mesh is not None:
                modeller.load_state(mesh.state)
                moved, now = True, mesh.state
    if target is not None:
        modeller.set_target(target.image, wake=target.follow or not current)
    elif moved:
        modeller.wake()
    return moved

"""States of a mesh to go back to, in bounded memory."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass

from .canvas import HISTORY
from .modeller import ModellerState

#: Bytes that all states may take together. The oldest states are dropped beyond.
MOST_BYTES = 256_000_000
#: Number of states. Undo and redo need one before and one after each edit; the rest are of edits that are forgotten.
MOST_STATES = 4 * HISTORY


@dataclass(frozen=True)
class KeptMesh:
    """A state of the mesh.

    Attributes:
        state: of mesh and optimiser.
        current: the mesh followed the newest target of that moment. False if the optimiser had not taken that target yet.
    """

    state: ModellerState
    current: bool


class MeshHistory:
    """Meshes by name. When they are too many or too large, the oldest ones are dropped, and `get` does not find them any more."""

    def __init__(self, most_bytes: int = MOST_BYTES, most_states: int = MOST_STATES) -> None:
        self._most_bytes, self._most_states = most_bytes, most_states
        self._meshes: dict[Hashable, KeptMesh] = {}

    def put(self, name: Hashable, mesh: KeptMesh) -> None:
        """Keep a mesh. It replaces an older one of the same name. A state of several names counts once."""
        self._meshes.pop(name, None)
        self._meshes[name] = mesh
        while self._meshes and (len(self._meshes) > self._most_states or self.bytes > self._most_bytes):
            del self._meshes[next(iter(self._meshes))]

    def get(self, name: Hashable) -> KeptMesh | None:
        """The mesh of this name, None if there is none or it has been dropped."""
        return self._meshes.get(name)

    @property
    def bytes(self) -> int:
        """Bytes of all states together."""
        return sum({id(mesh.state): mesh.state.bytes for mesh in self._meshes.values()}.values())

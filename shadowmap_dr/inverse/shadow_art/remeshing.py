"""A sculptor that remeshes its surface at intervals, so that triangles keep a similar size under large deformations."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError, install_hint
from ...jit.types import Float
from ...rendering.receivers.shadow_views import ShadowView
from .sculpt import Sculptor

# Rounds of splitting, collapsing and flipping edges in each remeshing.
_ROUNDS = 5

Array = npt.NDArray[np.float32]


class RemeshingSculptor:
    """A `Sculptor` that remeshes its surface every ``interval`` steps, to triangles of about the same size.

    The method is that of Botsch and Kobbelt, "A Remeshing Approach to Multiresolution Modeling" (2004), from the package
    gpytoolbox. The optimiser restarts with each mesh. Closed surfaces stay closed.

    Args:
        vertices, faces, views, targets: see `Sculptor`.
        interval: steps between two remeshings.
        options: further arguments of `Sculptor`.

    Raises ShadowmapError as `Sculptor` does, and if gpytoolbox is missing.
    """

    def __init__(
        self,
        vertices: npt.ArrayLike,
        faces: npt.ArrayLike,
        views: Sequence[ShadowView],
        targets: Sequence[npt.ArrayLike],
        *,
        interval: int = 100,
        **options: Any,  # Any: arguments of `Sculptor`
    ) -> None:
        if interval < 1:
            raise ShadowmapError(f"remeshing every {interval} steps: give at least 1.")
        _remesher()
        self.views, self._interval, self._options = tuple(views), interval, options
        self._steps = 0
        self._first = np.array(vertices, np.float32)
        self._sculptor = Sculptor(vertices, faces, views, targets, **options)
        self._settings = {**self._sculptor.describe(), "remesh_interval": interval}

    @property
    def faces(self) -> npt.NDArray[np.uint32]:
        """Faces (F, 3); a step may change them."""
        return self._sculptor.faces

    def step(self) -> Float:
        """Remesh if it is time, then take one step. Returns the loss before it, ``Float`` (1,), without waiting."""
        if self._steps and self._steps % self._interval == 0:
            self._replace(*remeshed(self._sculptor.vertices(), self._sculptor.faces))
        self._steps += 1
        return self._sculptor.step()

    def vertices(self) -> Array:
        """Vertices (V, 3), world space, after the last step."""
        return self._sculptor.vertices()

    def visibility(self) -> list[Array]:
        """Visibility image (H, W) of each view, see `Sculptor`."""
        return self._sculptor.visibility()

    def target(self, view: int) -> Array:
        """Target image (H, W) of a view, a copy."""
        return self._sculptor.target(view)

    def set_target(self, view: int, image: npt.ArrayLike) -> None:
        """Replace the target of a view, see `Sculptor`."""
        self._sculptor.set_target(view, image)

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """The mesh as it was after the last remeshing, the number of steps, and the state of its `Sculptor`."""
        mesh = {"mesh.vertices": self._first, "mesh.faces": self.faces, "all_steps": np.array([self._steps])}
        return {**self._sculptor.state(), **mesh}

    def load_state(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Continue from a result of `state`."""
        self._replace(state["mesh.vertices"], state["mesh.faces"])
        self._sculptor.load_state(state)
        self._steps = int(np.asarray(state["all_steps"]).reshape(-1)[0])

    def describe(self) -> dict[str, Any]:
        """Settings for the record. Numbers of vertices and faces are those of the first mesh."""
        return dict(self._settings)

    def _replace(self, vertices: npt.ArrayLike, faces: npt.ArrayLike) -> None:
        targets = [self._sculptor.target(k) for k in range(len(self.views))]
        # Order and meaning of the numbers in a sculptor's state follow from its first vertices: keep them.
        self._first = np.array(vertices, np.float32)
        self._sculptor = Sculptor(vertices, faces, self.views, targets, **self._options)


def remeshed(vertices: npt.ArrayLike, faces: npt.ArrayLike) -> tuple[Array, npt.NDArray[np.uint32]]:
    """Remesh a surface to triangles whose edges have about the mean length of the old edges.

    Args:
        vertices: (V, 3).
        faces: (F, 3).

    Raises ShadowmapError if the package gpytoolbox is missing, or cannot remesh this surface.
    """
    p, f = np.asarray(vertices, np.float64), np.asarray(faces, np.int32)
    edges = np.concatenate([p[f[:, k]] - p[f[:, (k + 1) % 3]] for k in range(3)])
    length = float(np.linalg.norm(edges, axis=1).mean())
    remesh = _remesher()
    try:
        new_vertices, new_faces = remesh(p, f, i=_ROUNDS, h=length, project=True)
    except Exception as error:  # gpytoolbox does not document its exceptions
        raise ShadowmapError(f"a mesh of {len(f)} triangles cannot be remeshed: {' '.join(str(error).split())}.") from error
    if not len(new_faces) or not np.isfinite(new_vertices).all():
        raise ShadowmapError(f"a mesh of {len(f)} triangles cannot be remeshed: the result is empty.")
    return np.asarray(new_vertices, np.float32), np.asarray(new_faces, np.uint32)


def _remesher() -> Callable[..., Any]:
    try:
        from gpytoolbox import remesh_botsch
    except ModuleNotFoundError as error:
        raise ShadowmapError(f"remeshing needs the package gpytoolbox: {install_hint('remesh')}.") from error
    return remesh_botsch

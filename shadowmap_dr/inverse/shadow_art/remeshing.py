"""A sculptor that meshes its surface anew from time to time, so that triangles stay even however far they are drawn out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...rendering.receivers.shadow_views import ShadowView
from .sculpt import Sculptor

# Rounds of splitting, collapsing and flipping edges, each time.
_ROUNDS = 5

Array = npt.NDArray[np.float32]


class RemeshingSculptor:
    """Like `Sculptor`, and every so many steps the surface gets other triangles, all of about the same size.

    The method is that of Botsch and Kobbelt, "A Remeshing Approach to Multiresolution Modeling" (2004), as the package gpytoolbox
    has it. The optimiser starts afresh with each mesh. Closed surfaces stay closed.

    Args:
        vertices, faces, views, targets: see `Sculptor`.
        interval: steps with the same triangles.
        options: further arguments of `Sculptor`.

    Raises ShadowmapError as `Sculptor` does, and where gpytoolbox is missing.
    """

    def __init__(
        self,
        vertices: npt.ArrayLike,
        faces: npt.ArrayLike,
        views: Sequence[ShadowView],
        targets: Sequence[npt.ArrayLike],
        *,
        interval: int = 100,
        **options: Any,
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
        """(F, 3); a step may change them."""
        return self._sculptor.faces

    def step(self) -> Any:
        """One step, before which the surface may be meshed anew; returns the loss before it, ``Float`` (1,)."""
        if self._steps and self._steps % self._interval == 0:
            self._replace(*remeshed(self._sculptor.vertices(), self._sculptor.faces))
        self._steps += 1
        return self._sculptor.step()

    def vertices(self) -> Array:
        """(V, 3), world space, after the last step."""
        return self._sculptor.vertices()

    def visibility(self) -> list[Array]:
        """(H, W) for each view."""
        return self._sculptor.visibility()

    def target(self, view: int) -> Array:
        """(H, W), a copy."""
        return self._sculptor.target(view)

    def set_target(self, view: int, image: npt.ArrayLike) -> None:
        """See `Sculptor`."""
        self._sculptor.set_target(view, image)

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """The mesh as it was when it was made, the number of steps, and the state of the sculptor that works on it."""
        mesh = {"mesh.vertices": self._first, "mesh.faces": self.faces, "all_steps": np.array([self._steps])}
        return {**self._sculptor.state(), **mesh}

    def load_state(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Go on from what `state` returned."""
        self._replace(state["mesh.vertices"], state["mesh.faces"])
        self._sculptor.load_state(state)
        self._steps = int(np.asarray(state["all_steps"]).reshape(-1)[0])

    def describe(self) -> dict[str, Any]:
        """Settings for the record; numbers of vertices and faces are those of the start."""
        return dict(self._settings)

    def _replace(self, vertices: npt.ArrayLike, faces: npt.ArrayLike) -> None:
        targets = [self._sculptor.target(k) for k in range(len(self.views))]
        # The state of a sculptor belongs to the vertices that it began with: the order of its numbers follows from them.
        self._first = np.array(vertices, np.float32)
        self._sculptor = Sculptor(vertices, faces, self.views, targets, **self._options)


def remeshed(vertices: npt.ArrayLike, faces: npt.ArrayLike) -> tuple[Array, npt.NDArray[np.uint32]]:
    """The same surface of triangles with edges of about the same length, the mean length of those that it had.

    Args:
        vertices: (V, 3).
        faces: (F, 3).

    Raises ShadowmapError where the package gpytoolbox is missing, or cannot mesh this surface.
    """
    p, f = np.asarray(vertices, np.float64), np.asarray(faces, np.int32)
    edges = np.concatenate([p[f[:, k]] - p[f[:, (k + 1) % 3]] for k in range(3)])
    length = float(np.linalg.norm(edges, axis=1).mean())
    remesh = _remesher()
    try:
        new_vertices, new_faces = remesh(p, f, i=_ROUNDS, h=length, project=True)
    except Exception as error:  # what it raises is not documented
        raise ShadowmapError(f"a mesh of {len(f)} triangles cannot be meshed anew: {' '.join(str(error).split())}.") from error
    if not len(new_faces) or not np.isfinite(new_vertices).all():
        raise ShadowmapError(f"a mesh of {len(f)} triangles cannot be meshed anew: nothing is left of it.")
    return np.asarray(new_vertices, np.float32), np.asarray(new_faces, np.uint32)


def _remesher() -> Any:
    try:
        from gpytoolbox import remesh_botsch
    except ModuleNotFoundError as error:
        raise ShadowmapError("remeshing needs the package gpytoolbox: pip install 'shadowmap-dr[remesh]'.") from error
    return remesh_botsch

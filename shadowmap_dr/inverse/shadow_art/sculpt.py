"""Shadow art: a mesh is deformed, step by step, until its shadows are what the targets show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...jit.arrays import device_array
from ...rendering.receivers.shadow_images import ShadowImages, image_loss, shadow_images
from ...rendering.receivers.shadow_views import ShadowView
from .smoothness import normal_consistency

Array = npt.NDArray[np.float32]


class Sculptor:
    """Deforms a mesh so that its shadows match target images, which may change at any time.

    A `Method` of the optimisation loop; and what an interactive program calls:

        sculptor = Sculptor(vertices, faces, [shadow_view()])
        image = sculptor.visibility()[0]      # what the shadow looks like now: the first thing to paint on
        while True:                           # all in one thread
            sculptor.set_target(0, painted)   # whenever the user has changed it: costs less than a millisecond
            loss = sculptor.step()
            send(sculptor.vertices(), sculptor.faces, sculptor.visibility()[0])  # as often as somebody looks

    The first step compiles (a second or so) and is recorded; a new target is not. After an abrupt change of a target, `calm` lets
    the optimiser forget how large gradients used to be, or else the first steps towards the new target may be small. `state` and
    `load_state` serve undo and checkpoints, `reset` starts anew. Instances are not thread-safe: create and use one in a single
    thread, and hand arrays, which are copies, to other ones.

    A step is: vertices from the variable u = (1 + lambda L) v of Nicolet et al., "Large Steps in Inverse Rendering of Geometry"
    (2021), where L is the mesh's Laplacian; shadow maps; visibility of what the cameras see; loss; derivatives; Adam with one
    step size for all of u. The loss is the mean squared difference of visibility, summed over the views, plus `consistency` times
    `normal_consistency`. What is between the vertices and their derivative is recorded once with `dr.freeze`; the solver, which
    is no part of Dr.Jit, stays outside.

    Args:
        vertices: (V, 3), world space, objects around the origin (see `shadow_view`). Vertices at the same place stay together.
        faces: (F, 3).
        views: one or more, see `shadow_view`.
        targets: visibility (H, W) in 0 (dark) to 1 (lit) for each view, top row first. None: the shadows of the mesh as it is.
        step_size: of Adam on u.
        smoothness: lambda.
        consistency: weight of `normal_consistency`.
        map_resolution, filter_size, method: of the shadow maps.
        settings: further entries for `describe`.

    Raises ShadowmapError for a mesh, targets or settings that cannot be used, and where the package cholespy is missing.
    """

    def __init__(
        self,
        vertices: npt.ArrayLike,
        faces: npt.ArrayLike,
        views: Sequence[ShadowView],
        targets: Sequence[npt.ArrayLike] | None = None,
        *,
        step_size: float = 0.2,
        smoothness: float = 20.0,
        consistency: float = 0.2,
        map_resolution: int = 256,
        filter_size: int = 5,
        method: str = "esm",
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        for name, value in (("step size", step_size), ("smoothness", smoothness)):
            if not 0 < value < np.inf:
                raise ShadowmapError(f"a {name} of {value}: give a positive number.")
        if not 0 <= consistency < np.inf:
            raise ShadowmapError(f"a weight of {consistency} for normal consistency: give a number from 0 on.")
        self.views = tuple(views)
        self._shadows = shadow_images(
            vertices, faces, self.views, map_resolution=map_resolution, filter_size=filter_size, method=method
        )
        self._start = np.array(vertices, np.float32)
        self._faces = np.array(faces, np.uint32)
        self._step_size, self._settings = step_size, dict(settings or {})
        # An array, so that the recorded step does not depend on a number of Python's.
        self._consistency, self._smoothness = dr.opaque(mi.Float, consistency), smoothness
        self._solver = _large_steps(mi.Float(self._start.ravel()), self._shadows.faces, smoothness)
        self._gradient, self._look = dr.freeze(_gradient), dr.freeze(_look)
        self.reset()
        if targets is None:
            self._targets = [image.copy() for image in self.visibility()]
        elif len(targets) != len(self.views):
            raise ShadowmapError(f"{len(targets)} targets for {len(self.views)} views: give one for each.")
        else:
            self._targets = [checked_target(image, view) for image, view in zip(targets, self.views, strict=True)]
        self._wanted = None

    @property
    def faces(self) -> npt.NDArray[np.uint32]:
        """(F, 3), a copy; they never change."""
        return self._faces.copy()

    @property
    def steps(self) -> int:
        """Steps done since the start, or since what `load_state` was given."""
        return self._steps

    def set_target(self, view: int, image: npt.ArrayLike) -> None:
        """Replace the target of a view by a visibility image (H, W), 0 dark to 1 lit, of the same size. The mesh stays.

        Raises ShadowmapError, and keeps the old target, where there is no such view, or the image cannot be used.
        """
        if not 0 <= view < len(self.views):
            raise ShadowmapError(f"no view {view}: there are {len(self.views)}, counted from 0.")
        self._targets[view] = checked_target(image, self.views[view])
        self._wanted = None

    def target(self, view: int) -> Array:
        """(H, W), a copy."""
        return self._targets[view].copy()

    def step(self) -> Any:
        """One step; returns the loss before it, ``Float`` (1,), without waiting for it."""
        if self._wanted is None:
            self._wanted = device_array(mi.Float, np.concatenate([image.ravel() for image in self._targets]))
        loss, slope = self._gradient(dr.detach(self._vertices), self._wanted, self._consistency, self._shadows)
        dr.set_grad(self._vertices, slope)
        dr.enqueue(dr.ADMode.Backward, self._vertices)
        dr.traverse(dr.ADMode.Backward)
        self._optimizer.step()
        self._solve()
        self._steps += 1
        return loss

    def vertices(self) -> Array:
        """(V, 3), world space, after the last step."""
        return np.array(dr.detach(self._vertices), np.float32).reshape(-1, 3)

    def visibility(self) -> list[Array]:
        """(H, W) for each view: what its camera sees now, 0 (dark) to 1 (lit), top row first. 1 where it sees no receiver."""
        return self._shadows.images(self._look(dr.detach(self._vertices), self._shadows))

    def reset(self, vertices: npt.ArrayLike | None = None) -> None:
        """Start anew, from the first mesh or from other (V, 3) vertices of it, with an optimiser that knows of nothing."""
        start = self._start if vertices is None else np.asarray(vertices, np.float32)
        if start.shape != self._start.shape or not np.isfinite(start).all():
            raise ShadowmapError(f"vertices of shape {start.shape}: give {self._start.shape} finite numbers.")
        u = np.array(self._solver.to_differential(mi.Float(start.ravel())))
        self.load_state({"u": u, "m": np.zeros_like(u), "v": np.zeros_like(u), "t": np.zeros(1), "steps": np.zeros(1)})

    def calm(self) -> None:
        """Keep the mesh, but forget all past gradients."""
        state = self.state()
        zero = np.zeros_like(state["m"])
        self.load_state({**state, "m": zero, "v": zero, "t": np.zeros(1)})

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """The variable u, Adam's moments m and v, its step count t and the number of steps; all that `load_state` needs."""
        u, _, _, (t, m, v, _) = self._optimizer.state["u"]
        arrays = {"u": dr.detach(u), "m": m, "v": v, "t": t}
        return {**{name: np.array(array) for name, array in arrays.items()}, "steps": np.array([self._steps])}

    def load_state(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Go on from what `state` returned, possibly in another process. Targets stay as they are."""
        u, m, v = (device_array(mi.Float, state[name]) for name in ("u", "m", "v"))
        if {dr.width(u), dr.width(m), dr.width(v)} != {3 * self._solver.n_verts}:
            raise ShadowmapError(f"a state of {dr.width(u)} numbers for a mesh of {3 * self._solver.n_verts}.")
        self._optimizer = mi.ad.Adam(lr=self._step_size, uniform=True, params={"u": u})
        value, promoted, rate, (t, *_, v_max) = self._optimizer.state["u"]
        t = device_array(type(t), state["t"])
        self._optimizer.state["u"] = value, promoted, rate, (t, m, v, v_max)
        self._steps = int(np.asarray(state["steps"]).reshape(-1)[0])
        self._solve()

    def recordings(self) -> int:
        """Number of recordings of a step so far; stays the same once the sculptor is warm."""
        return int(self._gradient.n_recordings)

    def describe(self) -> dict[str, Any]:
        """Settings for the record."""
        shadow = self._shadows.settings
        return {
            **self._settings,
            "vertices": len(self._start), "faces": len(self._faces),
            "views": [view.describe() for view in self.views],
            "optimizer": "AdamUniform", "step_size": self._step_size, "smoothness": self._smoothness,
            "consistency": float(self._consistency[0]), "shadow_method": shadow.method, "map_resolution": shadow.resolution,
            "filter_size": shadow.filter_size,
        }  # fmt: skip

    def _solve(self) -> None:
        """Vertices from u, attached."""
        self._vertices = self._solver.from_differential(self._optimizer["u"])
        dr.eval(self._vertices)


def _large_steps(vertices: Any, faces: Any, smoothness: float) -> Any:
    try:
        return mi.ad.LargeSteps(vertices, faces, lambda_=smoothness)
    except ModuleNotFoundError as error:
        raise ShadowmapError("deforming meshes needs the package cholespy: pip install 'shadowmap-dr[art]'.") from error
    except ValueError as error:
        raise ShadowmapError(f"a smoothness of {smoothness:g} is too large for this mesh: use a smaller one.") from error


def checked_target(image: npt.ArrayLike, view: ShadowView) -> Array:
    """A copy of a view's target (H, W). Raises ShadowmapError where it has another shape, or values outside of 0..1."""
    pixels = np.array(image, np.float32)
    if pixels.shape != view.shape:
        raise ShadowmapError(f"a target of shape {pixels.shape} for images of shape {view.shape}.")
    if not (np.isfinite(pixels).all() and pixels.min() >= 0 and pixels.max() <= 1):
        raise ShadowmapError("a target has values outside of 0 (dark) to 1 (lit).")
    return pixels


def _gradient(vertices: Any, wanted: Any, consistency: Any, shadows: ShadowImages) -> tuple[Any, Any]:
    """(loss, derivative of the loss by the vertices)."""
    vertices = mi.Float(vertices)
    dr.enable_grad(vertices)
    seen = shadows.visibility(vertices)
    rough = consistency * normal_consistency(vertices, shadows.topology)
    loss = image_loss(shadows, seen, wanted) + dr.detach(rough)
    dr.set_grad(rough, 1)
    dr.enqueue(dr.ADMode.Backward, seen, rough)
    dr.traverse(dr.ADMode.Backward)
    return loss, dr.grad(vertices)


def _look(vertices: Any, shadows: ShadowImages) -> Any:
    return shadows.visibility(vertices)

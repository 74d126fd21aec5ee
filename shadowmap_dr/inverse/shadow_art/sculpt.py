"""Shadow art: a mesh is deformed step by step until its shadows match target images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError, install_hint
from ...jit.arrays import device_array
from ...jit.frozen import freeze, recordings_of
from ...jit.types import Float, UInt32
from ...rendering.receivers.checks import is_real, is_whole, real_array
from ...rendering.receivers.shadow_images import ShadowImages, image_loss, shadow_images
from ...rendering.receivers.shadow_views import ShadowView
from .smoothness import normal_consistency

Array = npt.NDArray[np.float32]


class Sculptor:
    """A mesh that is deformed until its shadows match target images, which may change at any time.

    For the optimisation loop of shadow art and for interactive programs:

        sculptor = Sculptor(vertices, faces, [shadow_view()])
        image = sculptor.visibility()[0]      # the current shadow, to paint on
        while True:                           # all in one thread
            sculptor.set_target(0, painted)   # whenever the user changes it: takes less than a millisecond
            loss = sculptor.step()
            send(sculptor.vertices(), sculptor.faces, sculptor.visibility()[0])  # as often as the display needs it

    The first step compiles (about a second) and is recorded; a new target needs neither. After an abrupt change of a target, call
    `calm`: it resets Adam's moments, whose large past gradients would make the first steps towards the new target small. `state`
    and `load_state` serve undo and checkpoints, `reset` restarts. Instances are not thread-safe: create and use one in a single
    thread, and hand the arrays, which are copies, to other threads.

    A step consists of: vertices from the variable u = (1 + lambda L) v of Nicolet et al., "Large Steps in Inverse Rendering of
    Geometry" (2021), where L is the mesh's Laplacian; shadow maps; visibility of the receivers in the cameras' images; loss;
    derivatives; Adam with one step size for all of u. The loss is the mean squared difference of visibility, summed over the
    views, plus `consistency` times `normal_consistency`. Everything from the vertices to their derivative is recorded once with
    `dr.freeze`; the linear solver of cholespy stays outside.

    Args:
        vertices: (V, 3), world space, objects around the origin (see `shadow_view`). Vertices at the same position stay together.
        faces: (F, 3).
        views: one or more, see `shadow_view`.
        targets: visibility (H, W) in 0 (dark) to 1 (lit) for each view, top row first. None: the shadows of the mesh as it is.
        step_size: of Adam on u.
        smoothness: lambda.
        consistency: weight of `normal_consistency`.
        map_resolution, filter_size, method: of the shadow maps.
        settings: further entries for `describe`.

    Raises ShadowmapError for an unusable mesh, target or setting, and if the package cholespy is missing.
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
            if not is_real(value) or not value > 0:
                raise ShadowmapError(f"a {name} of {value}: give a positive number.")
        if not is_real(consistency) or consistency < 0:
            raise ShadowmapError(f"a weight of {consistency} for normal consistency: give a number from 0 on.")
        self.views = tuple(views)
        self._shadows = shadow_images(
            vertices, faces, self.views, map_resolution=map_resolution, filter_size=filter_size, method=method
        )
        self._start = np.array(vertices, np.float32)
        self._faces = np.array(faces, np.uint32)
        self._step_size, self._settings = step_size, dict(settings or {})
        # An array: a Python number would become a constant of the recorded step.
        self._consistency, self._smoothness = dr.opaque(mi.Float, consistency), smoothness
        self._solver = _large_steps(device_array(mi.Float, self._start), self._shadows.faces, smoothness)
        self._gradient, self._look = freeze(_gradient), freeze(_look)
        self.reset()
        if targets is None:
            self._targets = [image.copy() for image in self.visibility()]
        elif len(targets) != len(self.views):
            raise ShadowmapError(f"{len(targets)} targets for {len(self.views)} views: give one for each.")
        else:
            self._targets = [checked_target(image, view) for image, view in zip(targets, self.views, strict=True)]
        self._wanted: Float | None = None

    @property
    def faces(self) -> npt.NDArray[np.uint32]:
        """Faces (F, 3), a copy. They never change."""
        return self._faces.copy()

    @property
    def steps(self) -> int:
        """Number of steps since the start, the steps before a loaded state included."""
        return self._steps

    def set_target(self, view: int, image: npt.ArrayLike) -> None:
        """Replace the target of a view by a visibility image (H, W), 0 dark to 1 lit, of the same size. The mesh stays.

        Raises ShadowmapError, and keeps the old target, if there is no such view or the image cannot be used.
        """
        if not is_whole(view) or not 0 <= view < len(self.views):
            raise ShadowmapError(f"no view {view}: there are {len(self.views)}, counted from 0.")
        self._targets[view] = checked_target(image, self.views[view])
        self._wanted = None

    def target(self, view: int) -> Array:
        """Target image (H, W) of a view, a copy."""
        return self._targets[view].copy()

    def step(self) -> Float:
        """Take one step. Returns the loss before the step, ``Float`` (1,), without waiting for the device."""
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
        """Vertices (V, 3), world space, after the last step."""
        return np.array(dr.detach(self._vertices), np.float32).reshape(-1, 3)

    def visibility(self) -> list[Array]:
        """Visibility image (H, W) of each view: 0 (dark) to 1 (lit), 1 where the camera sees no receiver. Top row first."""
        return self._shadows.images(self._look(dr.detach(self._vertices), self._shadows))

    def reset(self, vertices: npt.ArrayLike | None = None) -> None:
        """Restart from the first mesh or from other vertices (V, 3), with empty moments."""
        start = self._start if vertices is None else real_array("vertices", vertices)
        if start.shape != self._start.shape or not np.isfinite(start).all():
            raise ShadowmapError(f"vertices of shape {start.shape}: give {self._start.shape} finite numbers.")
        u = np.array(self._solver.to_differential(device_array(mi.Float, start)))
        self.load_state({"u": u, "m": np.zeros_like(u), "v": np.zeros_like(u), "t": np.zeros(1), "steps": np.zeros(1)})

    def calm(self) -> None:
        """Keep the mesh, but reset Adam's moments."""
        state = self.state()
        zero = np.zeros_like(state["m"])
        self.load_state({**state, "m": zero, "v": zero, "t": np.zeros(1)})

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """The variable u, Adam's moments m and v, its step count t and the number of steps: the input of `load_state`."""
        u, _, _, (t, m, v, _) = self._optimizer.state["u"]
        arrays = {"u": dr.detach(u), "m": m, "v": v, "t": t}
        return {**{name: np.array(array) for name, array in arrays.items()}, "steps": np.array([self._steps])}

    def load_state(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Continue from a result of `state`, possibly of another process. Targets stay as they are."""
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
        """Number of recordings of a step so far. It stays the same once the sculptor is warm."""
        return recordings_of(self._gradient)

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
        """Solve for the vertices from u. Attached."""
        self._vertices = self._solver.from_differential(self._optimizer["u"])
        dr.eval(self._vertices)


def _large_steps(vertices: Float, faces: UInt32, smoothness: float) -> mi.ad.LargeSteps:
    try:
        return mi.ad.LargeSteps(vertices, faces, lambda_=smoothness)
    except ModuleNotFoundError as error:
        raise ShadowmapError(f"deforming meshes needs the package cholespy: {install_hint('art')}.") from error
    except ValueError as error:
        raise ShadowmapError(f"a smoothness of {smoothness:g} is too large for this mesh: use a smaller one.") from error


def checked_target(image: npt.ArrayLike, view: ShadowView) -> Array:
    """A copy of a view's target (H, W). Raises ShadowmapError for another shape, or values outside of 0..1."""
    pixels = real_array("target", image)
    if pixels.shape != view.shape:
        raise ShadowmapError(f"a target of shape {pixels.shape} for images of shape {view.shape}.")
    if not (np.isfinite(pixels).all() and pixels.min() >= 0 and pixels.max() <= 1):
        raise ShadowmapError("a target has values outside of 0 (dark) to 1 (lit).")
    return pixels


def _gradient(vertices: Float, wanted: Float, consistency: Float, shadows: ShadowImages) -> tuple[Float, Float]:
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


def _look(vertices: Float, shadows: ShadowImages) -> Float:
    return shadows.visibility(vertices)

"""Shadow art from many objects: copies of one mesh are moved, turned and scaled until their joint shadow matches a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...jit.arrays import device_array
from ...jit.frozen import freeze
from ...jit.types import Float, Point3f
from ...rendering.receivers.checks import index_array, is_real, is_whole, real_array
from ...rendering.receivers.shadow_images import ShadowImages, image_loss, shadow_images
from ...rendering.receivers.shadow_views import ShadowView
from .sculpt import checked_target

# Numbers of each copy: offset (3), quaternion (4: x, y, z, w), logarithm of the scale.
_NUMBERS = 8
# Scale of the first copy, at the origin and not turned. World units for a mesh in [-1, 1]^3.
_FIRST_SCALE = 0.7
# Two copies replace one: their relative scale, and their distances from its centre, in units of its scale.
_SHRINK, _ASIDE, _APART = 0.8, 0.35, 0.3
# Largest distance of new copies' centres from the origin along the first view's light, which cannot bring them back.
_REACH = 1.0

Array = npt.NDArray[np.float32]


class Collection:
    """Copies of a mesh, fitted so that their joint shadows match target images. Begins with one copy; their number doubles.

    Args:
        vertices: (V, 3) of the mesh, about in [-1, 1]^3.
        faces: (F, 3).
        views: one or more, see `shadow_view`.
        targets: visibility (H, W) in 0 (dark) to 1 (lit) for each view.
        interval: steps after which each copy is replaced by two.
        most: largest number of copies.
        step_size: of Adam, on offsets (world units), quaternions and logarithms of scales.
        seed: of the random directions in which the two new copies move apart.
        map_resolution, filter_size, method: of the shadow maps.
        settings: further entries for `describe`.

    Raises ShadowmapError for an unusable mesh, target or setting.
    """

    def __init__(
        self,
        vertices: npt.ArrayLike,
        faces: npt.ArrayLike,
        views: Sequence[ShadowView],
        targets: Sequence[npt.ArrayLike],
        *,
        interval: int = 150,
        most: int = 128,
        step_size: float = 0.005,
        seed: int = 0,
        map_resolution: int = 256,
        filter_size: int = 5,
        method: str = "esm",
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        counts = all(map(is_whole, (interval, most, seed)))
        if not counts or interval < 1 or most < 1 or seed < 0 or not is_real(step_size) or not step_size > 0:
            raise ShadowmapError("a collection's interval, largest number and step size must be positive, its seed at least 0.")
        if len(targets) != len(views):
            raise ShadowmapError(f"{len(targets)} targets for {len(views)} views: give one for each.")
        self.views = tuple(views)
        self._targets = [checked_target(image, view) for image, view in zip(targets, self.views, strict=True)]
        self._wanted = device_array(mi.Float, np.concatenate([image.ravel() for image in self._targets]))
        self._rest = real_array("vertices", vertices)
        if self._rest.ndim != 2 or self._rest.shape[1] != 3:
            raise ShadowmapError(f"vertices of shape {self._rest.shape}: give (V, 3).")
        self._rest_faces = index_array("faces", faces, len(self._rest))
        if self._rest_faces.ndim != 2 or self._rest_faces.shape[1] != 3:
            raise ShadowmapError(f"faces of shape {self._rest_faces.shape}: give (F, 3).")
        self._shadow: dict[str, Any] = {"map_resolution": map_resolution, "filter_size": filter_size, "method": method}
        self._interval, self._most, self._seed = interval, most, seed
        self._step_size, self._settings = step_size, dict(settings or {})
        self.reset()

    @property
    def count(self) -> int:
        """Current number of copies."""
        return self._count

    @property
    def faces(self) -> npt.NDArray[np.uint32]:
        """Faces of all copies, (count * F, 3)."""
        shift = np.arange(self._count, dtype=np.uint32) * np.uint32(len(self._rest))
        return (self._rest_faces + shift[:, None, None]).reshape(-1, 3)

    def reset(self) -> None:
        """Restart with one copy."""
        numbers = np.array([0, 0, 0, 0, 0, 0, 1, np.log(_FIRST_SCALE)])
        zero = np.zeros_like(numbers)
        self.load_state({"numbers": numbers, "m": zero, "v": zero, "t": np.zeros(1), "steps": np.zeros(1)})

    def step(self) -> Float:
        """Double the copies if it is time, then take one step. Returns the loss before it, ``Float`` (1,), without waiting."""
        if self._steps and self._steps % self._interval == 0 and 2 * self._count <= self._most:
            self._double()
        numbers = self._optimizer["numbers"]
        loss, slope = self._gradient(dr.detach(numbers), self._points, self._wanted, self._shadows)
        dr.set_grad(numbers, slope)
        self._optimizer.step()
        self._steps += 1
        return loss

    def vertices(self) -> Array:
        """Vertices of all copies, (count * V, 3), world space, after the last step."""
        placed = _placed(dr.detach(self._optimizer["numbers"]), self._points)
        return np.array(placed, np.float32).reshape(-1, 3)

    def visibility(self) -> list[Array]:
        """Visibility image (H, W) of each view: 0 (dark) to 1 (lit), top row first."""
        return self._shadows.images(self._look(dr.detach(self._optimizer["numbers"]), self._points, self._shadows))

    def target(self, view: int) -> Array:
        """Target image (H, W) of a view, a copy."""
        return self._targets[view].copy()

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Numbers of all copies, Adam's moments m and v, its step count t and the number of steps."""
        numbers, _, _, (t, m, v, _) = self._optimizer.state["numbers"]
        arrays = {"numbers": dr.detach(numbers), "m": m, "v": v, "t": t}
        return {**{name: np.array(array) for name, array in arrays.items()}, "steps": np.array([self._steps])}

    def load_state(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Continue from a result of `state`, with any number of copies. Raises ShadowmapError if numbers are missing."""
        numbers, m, v = (device_array(mi.Float, state[name]) for name in ("numbers", "m", "v"))
        if dr.width(numbers) % _NUMBERS or {dr.width(m), dr.width(v)} != {dr.width(numbers)}:
            raise ShadowmapError(f"a state of {dr.width(numbers)} numbers: it must hold {_NUMBERS} for each copy.")
        self._prepare(dr.width(numbers) // _NUMBERS)
        self._optimizer = mi.ad.Adam(lr=self._step_size, params={"numbers": numbers})
        value, promoted, rate, (t, *_, v_max) = self._optimizer.state["numbers"]
        t = type(t)(np.asarray(state["t"], np.uint32))
        self._optimizer.state["numbers"] = value, promoted, rate, (t, m, v, v_max)
        self._steps = int(np.asarray(state["steps"]).reshape(-1)[0])

    def describe(self) -> dict[str, Any]:
        """Settings for the record."""
        return {
            **self._settings, "object_vertices": len(self._rest), "object_faces": len(self._rest_faces),
            "views": [view.describe() for view in self.views], "optimizer": "Adam", "step_size": self._step_size,
            "interval": self._interval, "most": self._most, "seed": self._seed, **self._shadow,
        }  # fmt: skip

    def _prepare(self, count: int) -> None:
        """Set up everything that depends on the number of copies."""
        self._count = count
        # Apart from each other: coinciding vertices of two copies must not be merged.
        apart = self._rest + np.arange(count, dtype=np.float32)[:, None, None] * np.float32(4)
        self._shadows = shadow_images(apart.reshape(-1, 3), self.faces, self.views, **self._shadow)
        self._points = mi.Point3f(*(device_array(mi.Float, np.tile(self._rest[:, c], count)) for c in range(3)))
        self._gradient, self._look = freeze(_gradient), freeze(_look)

    def _double(self) -> None:
        """Replace each copy by two smaller ones, side by side in the image and at different depths."""
        rows = np.array(dr.detach(self._optimizer["numbers"]), np.float64).reshape(_NUMBERS, -1)
        angle = np.random.default_rng([self._seed, self._count]).uniform(0, 2 * np.pi, self._count)
        size = np.exp(rows[7])
        view = self.views[0]
        aside = np.cos(angle)[:, None] * view.right + np.sin(angle)[:, None] * view.up
        offset = (_ASIDE * aside + _APART * view.forward) * size[:, None]
        pair = [rows.copy(), rows.copy()]
        for copy, sign in zip(pair, (1, -1), strict=True):
            copy[:3] += sign * offset.T
            depth = view.forward @ copy[:3]
            copy[:3] += view.forward[:, None] * (np.clip(depth, -_REACH, _REACH) - depth)
            copy[7] += np.log(_SHRINK)
        numbers = np.concatenate(pair, 1).ravel()
        zero = np.zeros_like(numbers)
        self.load_state({"numbers": numbers, "m": zero, "v": zero, "t": np.zeros(1), "steps": np.array([self._steps])})


def _placed(numbers: Float, points: Point3f) -> Float:
    """Vertices ``Float`` (3 * N * V,) of N copies, attached to ``numbers``. ``points``: the mesh's vertices, repeated N times."""
    count = dr.width(numbers) // _NUMBERS
    each = dr.width(points) // count
    copy = dr.arange(mi.UInt32, count)
    # Each number is gathered once, so that no atomics are needed; the backward pass of `repeat` is a sum over neighbours.
    rows = (dr.gather(mi.Float, numbers, copy + row * count, mode=dr.ReduceMode.NoConflicts) for row in range(_NUMBERS))
    x, y, z, *quaternion, scale = (dr.repeat(row, each) for row in rows)
    i, j, k, w = quaternion
    axis, norm = mi.Vector3f(i, j, k), dr.fma(i, i, dr.fma(j, j, dr.fma(k, k, w * w)))
    p = mi.Vector3f(points)
    # A quaternion q of any length turns p by q p q* / |q|^2.
    turned = p + (2 * dr.rcp(norm)) * dr.cross(axis, dr.cross(axis, p) + w * p)
    return cast(Float, dr.ravel(mi.Point3f(dr.exp(scale) * turned + mi.Vector3f(x, y, z))))


def _gradient(numbers: Float, points: Point3f, wanted: Float, shadows: ShadowImages) -> tuple[Float, Float]:
    """(loss, derivative of the loss by the numbers)."""
    numbers = mi.Float(numbers)
    dr.enable_grad(numbers)
    seen = shadows.visibility(_placed(numbers, points))
    loss = image_loss(shadows, seen, wanted)
    dr.enqueue(dr.ADMode.Backward, seen)
    dr.traverse(dr.ADMode.Backward)
    return loss, dr.grad(numbers)


def _look(numbers: Float, points: Point3f, shadows: ShadowImages) -> Float:
    return shadows.visibility(_placed(numbers, points))

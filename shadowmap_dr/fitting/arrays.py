"""Parameters with many values: textures and vertices of meshes. Adam fits them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError, install_hint
from ..jit.arrays import device_array
from ..jit.types import Float
from ..rendering.renderer import Renderer
from .parameters import is_roughness, is_share
from .scene_change import SceneChange
from .vary import Vary

Array = npt.NDArray[np.float32]

# Adam's step for values between zero and one, and for vertices as a share of the mesh's extent.
_TEXTURE_STEP, _VERTEX_STEP = 0.02, 2e-3
# Weight of neighbours in Nicolet et al., "Large Steps in Inverse Rendering of Geometry", 2021.
_SMOOTHNESS = 20.0


class ArrayParameter(Protocol):
    """One entry of the list of things that vary, with many values.

    ``start`` (n,): the values of the scene.
    """

    @property
    def vary(self) -> Vary: ...

    @property
    def kind(self) -> str: ...

    @property
    def start(self) -> Array: ...

    def put(self, values: Float, change: SceneChange) -> None:
        """Write values (Float, n; attached) into a change."""

    def descent(self, values: Array) -> Descent:
        """A descent that begins at values (n,)."""

    def arrays(self, values: Array) -> dict[str, npt.NDArray[np.float64]]:
        """Values for records and files."""


class Descent(Protocol):
    """A descent by the gradient: Adam, in its own variables."""

    def step(self, gradient: Float, share: float) -> Float:
        """Take a step against a gradient by the values (Float, n), with a share of the usual step size. Returns the values."""


@dataclass(frozen=True, eq=False)
class TextureValues:
    """All values of an array of Mitsuba's, ``key``, of a shape; between ``low`` and ``high``."""

    vary: Vary
    key: str
    shape: tuple[int, ...]
    start: Array
    low: float
    high: float
    kind: str = "texture"

    def put(self, values: Float, change: SceneChange) -> None:
        factor = change.factors.get(self.key)
        change.arrays[self.key] = (values if factor is None else values * factor, self.shape)

    def descent(self, values: Array) -> Descent:
        return ValueDescent(values, self.low, self.high)

    def arrays(self, values: Array) -> dict[str, npt.NDArray[np.float64]]:
        return {"texture": values.reshape(self.shape).astype(np.float64)}

    @property
    def channels(self) -> int:
        """Values of a texel."""
        return self.shape[-1] if len(self.shape) == 3 else 1


@dataclass(frozen=True, eq=False)
class MeshVertices:
    """All vertices of a mesh, in world space, flat (3V,). ``faces`` (F, 3)."""

    vary: Vary
    shape: str
    faces: npt.NDArray[np.uint32]
    start: Array
    kind: str = "vertices"

    def put(self, values: Float, change: SceneChange) -> None:
        change.vertices[self.shape] = values

    def descent(self, values: Array) -> Descent:
        return _VertexDescent(self, values)

    def arrays(self, values: Array) -> dict[str, npt.NDArray[np.float64]]:
        return {"vertices": values.reshape(-1, 3).astype(np.float64)}


class ValueDescent:
    """Adam on values within bounds."""

    def __init__(self, values: Array, low: float, high: float) -> None:
        self._low, self._high = low, high
        self._adam = mi.ad.Adam(lr=_TEXTURE_STEP, params={"values": device_array(mi.Float, values)})

    def step(self, gradient: Float, share: float) -> Float:
        self._adam.set_learning_rate({"values": _TEXTURE_STEP * share})
        values = self._adam["values"]
        dr.set_grad(values, gradient)
        self._adam.step()
        return self._set(self._adam["values"])

    def scaled(self, factor: float) -> Float:
        """Multiply the values (Float, n) by a factor. Returns them."""
        return self._set(self._adam["values"] * factor)

    def _set(self, values: Float) -> Float:
        self._adam["values"] = dr.clip(dr.detach(values), self._low, self._high)
        return dr.detach(self._adam["values"])


class _VertexDescent:
    """Adam with one step size for all, on the variable of large steps."""

    def __init__(self, mesh: MeshVertices, values: Array) -> None:
        points = device_array(mi.Float, values)
        try:
            self._steps = mi.ad.LargeSteps(points, device_array(mi.UInt32, mesh.faces.ravel()), lambda_=_SMOOTHNESS)
        except (ImportError, ModuleNotFoundError) as error:
            raise ShadowmapError(f"{mesh.vary.named}: the package cholespy is missing: {install_hint('art')}") from error
        extent = float(np.ptp(mesh.start.reshape(-1, 3), axis=0).max()) or 1.0
        self._rate = _VERTEX_STEP * extent * (1 + _SMOOTHNESS)
        self._adam = mi.ad.Adam(lr=self._rate, uniform=True, params={"u": self._steps.to_differential(points)})

    def step(self, gradient: Float, share: float) -> Float:
        self._adam.set_learning_rate({"u": self._rate * share})
        points = self._steps.from_differential(self._adam["u"])
        dr.set_grad(points, gradient)
        dr.enqueue(dr.ADMode.Backward, points)
        dr.traverse(dr.ADMode.Backward)
        self._adam.step()
        with dr.suspend_grad():
            return dr.detach(self._steps.from_differential(self._adam["u"]))


def texture_values(renderer: Renderer, vary: Vary, key: str) -> TextureValues:
    """The parameter of an array of Mitsuba's."""
    value = mi.traverse(renderer.data.scene)[key]
    flat = np.array(dr.detach(value), np.float32)
    shape = tuple(int(n) for n in value.shape) if dr.is_tensor_v(value) else flat.shape
    share = is_share(key) or is_roughness(key)
    given = [name for name in ("prior", "spread") if name in vary.plain()]
    if given:
        raise ShadowmapError(f"{vary.named}: textures have no {given[0]}: leave it out.")
    low = vary.low if vary.low is not None else 0.0
    high = vary.high if vary.high is not None else 1.0 if share else np.inf
    if low >= high:
        raise ShadowmapError(f"{vary.named}: the bounds leave nothing between {low:g} and {high:g}.")
    return TextureValues(vary, key, shape, flat.ravel(), low, high)


def has_vertices(renderer: Renderer, shape: str) -> bool:
    """True for meshes; False for round shapes, curves, and parts of instances, which others may share."""
    source = renderer.data.sources[[info.name for info in renderer.data.geometry.shapes].index(shape)]
    return isinstance(source.shape, mi.Mesh) and source.instance is None


def mesh_vertices(renderer: Renderer, vary: Vary, shape: str) -> MeshVertices:
    """The parameter of the vertices of a mesh."""
    given = [name for name in ("min", "max", "prior", "spread") if name in vary.plain()]
    if given:
        raise ShadowmapError(f"{vary.named}: vertices have no {given[0]}: leave it out.")
    geometry = renderer.data.geometry
    if not has_vertices(renderer, shape):
        raise ShadowmapError(f"{vary.named}: {shape} is no mesh of its own, and has no vertices to vary: give another kind.")
    info = geometry.shape(shape)
    faces = geometry.faces.numpy().reshape(-1, 3)[info.face_start : info.face_start + info.face_count] - info.vertex_start
    points = np.array(dr.detach(geometry.positions), np.float32).reshape(-1, 3)
    own = points[info.vertex_start : info.vertex_start + info.vertex_count]
    if not np.isfinite(own).all():
        raise ShadowmapError(f"{vary.named}: shape '{shape}' has vertices that are not finite.")
    return MeshVertices(vary, shape, faces.astype(np.uint32), own.ravel())

"""Plan of the translucent surfaces of a scene: its faces by kind, and the numbers of layers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import inf
from typing import ClassVar

import drjit as dr
import numpy as np

from ...jit.types import Bool, Float
from ...raster import RasterOutput, Topology, deepest
from ...scene.geometry import Geometry
from ...scene.load import SceneData
from ...scene.sensor import Sensor
from ...scene.sums import attached_parameters
from ...shadow import TranslucentCasters
from .translucent_faces import Faces, faces_of
from .translucent_layers import Layers, see_layers
from .transmission import loss_counts, mean_transmittance, towards_lights

#: Most layers where their number is found.
AUTO_LAYERS = 32
# Most surfaces that are looked at. Layers before they are counted.
_MOST_PASSES, _START = 64, 4
#: Clip-space vertices of all maps, texels along each side, number of maps.
Maps = tuple[Float, int, int]


@dataclass(frozen=True)
class LayerCounts:
    """Numbers of translucent surfaces along a ray. Static.

    Attributes:
        layers: of those that are kept.
        passes: of those that are looked at.
    """

    layers: int = 1
    passes: int = 1


@dataclass(frozen=True)
class Translucency:
    """Faces of a scene that let light through, and the numbers of layers. Static.

    Attributes:
        opaque: ``Bool`` (F,), the opaque faces of the scene.
        faces: the translucent ones; None if the others are unseen.
        camera, maps: layers along the rays of cameras and of lights.
        fixed: number of layers that was asked for, None for as many as there are.
        texel_density: of transmittance maps, see :func:`~shadowmap_dr.rendering.light_tiles.texel_density`.
    """

    RECORDED_OFTEN: ClassVar[bool] = True  # see `jit.frozen.take_apart`

    opaque: Bool
    faces: Faces | None
    camera: LayerCounts = LayerCounts()
    maps: LayerCounts = LayerCounts()
    fixed: int | None = None
    texel_density: float = inf

    @classmethod
    def of(cls, data: SceneData, positions: np.ndarray, layers: int | None) -> Translucency | None:
        """The faces of a scene (on the host, once); None if all faces are opaque.

        Args:
            data: the scene.
            positions: (V, 3) vertices of its geometry.
            layers: number of layers; None for as many as there are.
        """
        opaque, faces = faces_of(data, positions)
        if opaque is None:
            return None
        start = LayerCounts(layers or _START, max(layers or _START, 2 * _START))
        return cls(opaque, faces, start, start, layers)

    def counted(
        self,
        data: SceneData,
        geometry: Geometry,
        camera: Sensor,
        views: Sequence[tuple[Float, RasterOutput]],
        maps: Sequence[Maps],
    ) -> Translucency:
        """The same faces with as many layers as there are along the rays of cameras and lights (on the host, once).

        Args:
            data, geometry: the scene, and its shapes where they are now.
            camera: any camera.
            views: (clip-space vertices, raster of the opaque surfaces) of cameras.
            maps: (clip-space vertices of all maps, texels along each side, number of maps) of lights.
        """
        faces = self.faces
        if faces is None:
            return self
        passed = mean_transmittance(data, geometry, camera, faces)
        seen, lit = [], []
        for clip, opaque in views:
            before = partial(_before, opaque, passed)
            size = opaque.height, opaque.width
            seen.append(deepest(clip, faces.corners, size, passed=before, most=_MOST_PASSES))
        for clip, side, count in maps:
            lit.append(deepest(clip, faces.corners, (side, side), batch=count, passed=passed, most=_MOST_PASSES))
        return replace(self, camera=self._counts(seen), maps=self._counts(lit))

    def _counts(self, found: Sequence[tuple[int, int]]) -> LayerCounts:
        """Numbers of layers for the largest (layers, passes), and room for shapes that move before each other."""
        layers, passes = (max((pair[k] for pair in found), default=0) for k in range(2))
        if self.fixed is not None:
            return LayerCounts(self.fixed, max(self.fixed, passes))
        room = AUTO_LAYERS if self.faces is None or self.faces.room is None else self.faces.room
        layers, passes = (min(max(number + 1, 1), most) for number, most in ((layers, AUTO_LAYERS), (passes, _MOST_PASSES)))
        return LayerCounts(min(layers, room), max(min(passes, room), min(layers, room)))

    @property
    def topology(self) -> Topology | None:
        """Edges of the translucent faces alone."""
        return None if self.faces is None else self.faces.topology

    def layers(self, data: SceneData, geometry: Geometry, camera: Sensor, clip: Float, opaque: RasterOutput) -> Layers | None:
        """The translucent surfaces that a camera sees before the opaque ones. Attached to ``clip`` (4 V,)."""
        faces, count = self.faces, self.camera
        if faces is None:
            return None
        solid = loss_counts(data, geometry, camera, faces)
        attached = self.attached(geometry) or dr.grad_enabled(camera)
        return see_layers(clip, geometry, faces, opaque, (count.layers, count.passes), solid, attached)

    def casters(
        self, data: SceneData, geometry: Geometry, camera: Sensor, topology: Topology | None
    ) -> TranslucentCasters | None:
        """The translucent casters of shadow maps.

        ``topology``: :attr:`topology` where shapes are now; ``camera``: any camera.
        """
        faces, count = self.faces, self.maps
        if faces is None:
            return None
        assert topology is not None, "placed together with the translucent faces"
        return TranslucentCasters(
            faces.corners,
            topology,
            count.layers,
            count.passes,
            towards_lights(data, geometry, camera, faces),
            loss_counts(data, geometry, camera, faces),
            self.attached(geometry),
        )

    def attached(self, geometry: Geometry) -> bool:
        """True if vertices or materials of translucent shapes may carry gradients."""
        if self.faces is None:
            return False
        moving = any(info.see_through and geometry.attached(info) for info in geometry.shapes)
        return moving or bool(attached_parameters(self.faces.bsdfs))


def _before(opaque: RasterOutput, passed: Callable[[RasterOutput], Float], seen: RasterOutput) -> Float:
    """Share of the light that surfaces let through, 1 behind opaque ones."""
    hidden = opaque.valid & (seen.depth >= opaque.depth)
    return dr.select(hidden, 1, passed(seen))

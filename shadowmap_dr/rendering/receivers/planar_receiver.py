"""Shadows on a plane that nothing but the lights see: the visibility image of a planar receiver, without camera or shading.

The cheapest shadow image there is. Where a camera between casters and receiver would look at nothing but the receiver, its pixels
are fixed points of the plane: no camera pass is needed, and maps need not follow the casters, since the plane says which part
of the light counts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...jit.arrays import device_array
from ...jit.types import Float, Point3f, UInt32
from ...raster import Topology, build_topology
from ...shadow import (
    Frusta,
    LightView,
    ShadowSettings,
    Views,
    filter_maps,
    render_maps,
    stack_views,
    vertices_in_maps,
    visibility,
)

# Space around the window in a map in shares of its size, and thickness of the slab before the receiver in which casters are not
# allowed for in shares of the reach.
_MARGIN = 0.02


@dataclass(frozen=True)
class Window:
    """A rectangle of the plane z = ``z``, seen along -z with y up: ``low`` and ``high`` corner (x, y), world units."""

    low: tuple[float, float]
    high: tuple[float, float]
    z: float = -2.0

    def __post_init__(self) -> None:
        sides = [b - a for a, b in zip(self.low, self.high, strict=True)]
        if not all(math.isfinite(side) and side > 0 for side in sides) or not math.isfinite(self.z):
            raise ShadowmapError(f"a receiver from {self.low} to {self.high}: give corners with growing, finite coordinates.")

    @property
    def size(self) -> tuple[float, float]:
        """Width and height, world units."""
        return self.high[0] - self.low[0], self.high[1] - self.low[1]

    def pixels(self, height: int) -> tuple[int, int]:
        """(rows, columns) of an image that has so many rows of square pixels, as nearly as possible."""
        return height, max(1, round(height * self.size[0] / self.size[1]))


@dataclass(frozen=True)
class ReceiverShadows:
    """The shadow of one mesh on a rectangle, under directional lights of equal strength. A PyTree: may cross ``dr.freeze``.

    Attributes:
        points: ``Array3f`` (H * W), world-space centres of the pixels, top row first.
        faces, topology: of the mesh.
        views, frusta: cameras of the M maps, one for each light.
        settings: of the maps.
        shape: (H, W).
    """

    points: Point3f
    faces: UInt32
    topology: Topology
    views: Views
    frusta: Frusta
    settings: ShadowSettings
    shape: tuple[int, int]

    @classmethod
    def build(
        cls,
        faces: npt.ArrayLike,
        positions: npt.ArrayLike,
        directions: Sequence[tuple[float, float, float]],
        window: Window,
        height: int,
        settings: ShadowSettings,
        reach: float,
    ) -> ReceiverShadows:
        """Set up the maps of a mesh.

        Args:
            faces: (F, 3) valid vertex indices.
            positions: (V, 3) any positions of the vertices, world space: they tell which vertices are one and the same.
            directions: of the M lights, in which light travels: towards the receiver, so with a negative z. Any length.
            window: the receiver. Casters lie before it (greater z).
            height: rows of the image.
            settings: of the maps.
            reach: how far casters may lie before the receiver, along z, world units: beyond, they are cut off.

        Raises ShadowmapError for a light that does not strike the receiver.
        """
        for direction in directions:
            if not all(map(math.isfinite, direction)) or not direction[2] < 0:
                raise ShadowmapError(f"a light travelling along {tuple(direction)} misses the receiver: its z must be negative.")
        rows, columns = window.pixels(height)
        x = window.low[0] + (np.arange(columns) + 0.5) / columns * window.size[0]
        y = window.high[1] - (np.arange(rows) + 0.5) / rows * window.size[1]
        across, up = (device_array(mi.Float, a) for a in np.meshgrid(x, y))
        points = mi.Point3f(across, up, dr.full(mi.Float, window.z, rows * columns))
        triangles = np.asarray(faces).reshape(-1, 3)
        views = stack_views([_view(direction) for direction in directions])
        frusta = _frusta(directions, window, reach)
        dr.eval(points, views, frusta)
        return cls(
            points,
            device_array(mi.UInt32, triangles),
            build_topology(triangles, np.asarray(positions), mi.UInt32),
            views,
            frusta,
            settings,
            (rows, columns),
        )

    def render(self, positions: Float) -> Float:
        """Mean visibility over the lights.

        Args:
            positions: ``Float`` (3V,), world-space vertices. Attached.

        Returns:
            ``Float`` (H * W,) in 0..1, top row first: with one light 1 where it is lit, 0 in full shadow. Gradients flow to
            the positions.
        """
        count = self.views.count
        p_light, light, _ = vertices_in_maps(self.views, positions)
        maps = filter_maps(render_maps(p_light, light, self.faces, self.topology, self.views, self.frusta, self.settings))
        dr.eval(maps.values)
        total = mi.Float(0)
        for k in range(count):
            total += visibility(maps, mi.UInt32(k), self.points)
        return total / count


def _view(direction: tuple[float, float, float]) -> LightView:
    """An oblique parallel view: depth is the distance from the plane, and image coordinates are where light strikes the plane.

    All receiver points then have the same depth in all maps, however the light slants, and maps are sampled as the receiver is.
    """
    x, y, z = map(float, direction)
    right, up, forward = mi.Vector3f(1.0, 0.0, -x / z), mi.Vector3f(0.0, 1.0, -y / z), mi.Vector3f(0.0, 0.0, -1.0)
    return LightView(right, up, forward, mi.Vector3f(0.0, 0.0, 0.0), mi.Float(0))


def _frusta(directions: Sequence[tuple[float, float, float]], window: Window, reach: float) -> Frusta:
    """Maps that cover the shadows in a window and nothing else. Constant, so that an optimisation never sees a fit move.

    Depths are told apart only just before the receiver: all casters then count as equally far from it, and a variance shadow
    map is exact for them, since a texel holds no more than two depths.
    """
    gap = _MARGIN * reach
    shift = np.array([(x / z, y / z) for x, y, z in directions]) * window.z  # of the origin of image coordinates
    center = 0.5 * (np.array(window.low) + np.array(window.high)) - shift
    half = np.broadcast_to(0.5 * (1 + 2 * _MARGIN) * np.array(window.size), center.shape)
    depths = [np.full(len(center), depth - window.z) for depth in (-reach, -0.5 * gap, -gap)]
    values = (center[:, 0], center[:, 1], half[:, 0], half[:, 1], *depths, depths[1])
    return Frusta(*(device_array(mi.Float, value) for value in values))

"""Where surfaces meet without an edge: lines along which one passes through another, or stands on it.

No silhouette lies between two pixels there, but what they see changes at once. The depths of both triangles are affine on the
screen, so that the place between the pixels' centres where they are equal follows from six vertices.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from ._types import NO_TRIANGLE, RasterOutput, backend
from .setup import edge_lines, gather_triangle
from .topology import Topology

# Depths whose difference changes by less (relative) from one pixel to the next are the same: the surfaces lie on each other.
_LEAST_CHANGE = 1e-6


@dataclass(frozen=True)
class Meetings:
    """What it takes to find out where the surfaces that two neighbouring pixels see meet. Detached.

    Attributes:
        positions: flat clip-space vertices (4 V B), as rasterized.
        faces: ``UInt32`` (3 F,).
        parts: ``UInt32`` (F,), see :class:`Topology`.
        triangle: what each pixel sees.
        height, width, vertex_count: of an image.
    """

    positions: Any
    faces: Any
    parts: Any
    triangle: Any
    height: int
    width: int
    vertex_count: int

    @classmethod
    def of(cls, positions: Any, topology: Topology, raster: RasterOutput, vertex_count: int) -> Meetings:
        return cls(
            dr.detach(positions), topology.faces, topology.parts, raster.triangle, raster.height, raster.width, vertex_count
        )

    def possible(self, here: Any, there: Any) -> Any:
        """Whether two triangles (or none) belong to different surfaces: one surface seldom passes through itself."""
        UInt32 = backend(here).UInt32
        both = (here != NO_TRIANGLE) & (there != NO_TRIANGLE)
        return both & (dr.gather(UInt32, self.parts, here, both) != dr.gather(UInt32, self.parts, there, both))

    def weight(self, pixel: Any, down: Any) -> Any:
        """Signed weight (see :class:`Crossings`) of pairs of pixels that see triangles, 0 where these do not meet in between."""
        return self._between(pixel, down)[0]

    def slopes(self, pixel: Any, down: Any) -> list[tuple[Any, Any]]:
        """(vertex, change of the weight with its clip-space position, ``Array4f``) for all six vertices."""
        _, rate, triangles = self._between(pixel, down)
        Array4f = backend(rate).Array4f
        result = []
        for sign, (vertices, plane, weights) in zip((1, -1), triangles, strict=True):
            # The depth A x + B y + C w = z of a corner: what its change violates, the plane makes up for.
            direction = Array4f(-plane[0], -plane[1], 1, -plane[2])
            result += [(vertices[k], direction * (sign * rate * weights[k])) for k in range(3)]
        return result

    def _between(self, pixel: Any, down: Any) -> tuple[Any, Any, list[Any]]:
        """Weight, its change with the first depth minus the second, and (vertices, depth plane, barycentrics / w) of both."""
        module = backend(self.positions)
        Float, Float64, UInt32 = module.Float, module.Float64, module.UInt32
        row_flat = pixel // self.width
        image = row_flat // self.height
        column, row = pixel - row_flat * self.width, row_flat - image * self.height
        first = image * self.vertex_count
        # Centre of the pixel, and the way to its neighbour, in NDC.
        x, y = (2 * Float64(column) + (1 - self.width)) / self.width, (2 * Float64(row) + (1 - self.height)) / self.height
        step_x, step_y = 2 / self.width, 2 / self.height
        step = dr.select(down, UInt32(self.width), 1)
        found, differences = [], []
        for p in (pixel, pixel + step):
            triangle = dr.gather(UInt32, self.triangle, p)
            corners = gather_triangle(self.positions, self.faces, triangle, first, True)
            lines, det = edge_lines(corners)
            inverse = dr.select(det != 0, dr.rcp(dr.select(det != 0, det, 1)), 0)
            lines = [[c * inverse for c in line] for line in lines]
            plane = [sum(line[c] * Float64(p.z) for line, p in zip(lines, corners, strict=True)) for c in range(3)]
            i = dr.gather(module.Array3u, self.faces, triangle)
            found.append(([first + i[k] for k in range(3)], lines, plane))
            differences.append(plane)
        a, b, c = (u - v for u, v in zip(*differences, strict=True))
        # First depth minus second here, and its change on the way to the neighbour.
        start, change = dr.fma(a, x, dr.fma(b, y, c)), dr.select(down, b * step_y, a * step_x)
        depth = found[0][2][0] * x + found[0][2][1] * y + found[0][2][2]
        meet = (start < 0) & (start + change > 0) & (change > _LEAST_CHANGE * dr.abs(depth))
        slope = dr.select(meet, dr.rcp(dr.select(meet, change, 1)), 0)
        t = -start * slope
        across = (a * step_x) ** 2
        along = (b * step_y) ** 2
        share = dr.clip(0.5 + (across - along) / dr.select(meet, across + along, 1), 0, 1)
        share = dr.select(meet, dr.select(down, 1 - share, share), 0)
        x, y = dr.select(down, x, x + t * step_x), dr.select(down, y + t * step_y, y)
        triangles = [
            (vertices, [Float(v) for v in plane], [Float(dr.fma(m, x, dr.fma(n, y, o))) for m, n, o in lines])
            for vertices, lines, plane in found
        ]
        return Float(share * (t - 0.5)), Float(-share * slope), triangles

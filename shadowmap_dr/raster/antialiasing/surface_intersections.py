"""Intersections of the surfaces that two neighbouring pixels see, other than in a common edge.

Surfaces intersect along lines where one passes through another, or stands on it. No silhouette lies between the pixels there, but
the visible surface changes abruptly. The planes of two flat faces of one surface also intersect between pixels if the faces in
between are too narrow for a pixel to see; that happens to a box of many triangles, seen from the side. The depths of both
triangles are affine on the screen, so that six vertices give the point between the pixels' centres where they are equal. Within
one surface this point is valid only if the surface is flat up to there, or cuts itself in both triangles: the planes of a curved
surface also cross at points that do not lie on it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import cast

import drjit as dr

from ...jit.arrays import backend, scatter_inc
from ...jit.kernel_inputs import double_input, uint_input
from ...jit.types import Bool, Float, Float64, UInt32, Vector4f
from ..topology import NO_VERTEX, Topology
from ..triangle_setup import Corners, Line, edge_lines, exact_centres, gather_triangle
from ..types import NO_TRIANGLE, RasterOutput, by_pixel, precise_rcp
from .creases import MarkedFaces
from .pixel_pairs import each_number

# Surfaces coincide if the difference of their depths changes by less than this (relative) from one pixel to the next.
_LEAST_CHANGE = 1e-6
# Faces of one surface are coplanar if their changes of depth from one pixel to the next differ by less than this (relative).
_LEAST_FOLD = 0.02
# Largest deviation of adjacent faces from the planes of both triangles, as a fraction of the bend between them. From there the
# crease fades; at twice this fraction it is gone. On curved surfaces the fraction is larger: about a half with one facet between.
_BENT = 0.05
# Least barycentric coordinate of a point inside a triangle that does not lie, up to rounding, on one of its edges.
_INSIDE = 1e-4
# Weight of a pair whose edge lies on the border between its pixels. It must not be 0, for a weight of 0 means no edge and no
# derivatives.
LEAST_WEIGHT = 1e-12
# Lanes that share the listed pairs. Few, so that threads get equal parts even of a short list.
_LANES = 1024


@dataclass(frozen=True)
class Meetings:
    """Inputs of the search for intersections of the triangles that two neighbouring pixels see. Detached.

    Attributes:
        positions: flat clip-space vertices (4 V B), as rasterized.
        faces: (3 F,) vertex indices.
        parts, beyond: (F,) and (3 F,), see :class:`Topology`.
        batch: number of images.
        height, width, vertex_count: of an image.
        unconnected: True to intersect faces of different parts, and faces of one part that cut each other.
        marked, crease_weights: creases, and their weights, see
            :func:`shadowmap_dr.raster.antialiasing.edge_crossings.find_crossings`. If None, faces of one part form no creases.
        slots, count: candidate pairs without an edge, as slots in the list of all pairs, and their number.
        here, there: triangles of the pairs in these slots, at the pixel and at its neighbour.
    """

    positions: Float
    faces: UInt32
    parts: UInt32
    beyond: UInt32
    batch: int
    height: int
    width: int
    vertex_count: int
    unconnected: bool
    marked: MarkedFaces | None
    crease_weights: Float | None
    slots: UInt32
    count: UInt32
    here: UInt32
    there: UInt32

    @classmethod
    def of(
        cls,
        positions: Float,
        topology: Topology,
        raster: RasterOutput,
        vertex_count: int,
        unconnected: bool = True,
        marked: MarkedFaces | None = None,
        crease_weights: Float | None = None,
    ) -> Meetings:
        size = raster.batch, raster.height, raster.width, vertex_count
        surfaces = topology.faces, topology.parts, topology.beyond
        UInt32, pairs = backend(raster.triangle).UInt32, 2 * dr.width(raster.triangle)
        slots, count, here, there = dr.empty(UInt32, pairs), dr.zeros(UInt32, 1), dr.empty(UInt32, pairs), dr.empty(UInt32, pairs)
        found = slots, count, here, there
        return cls(dr.detach(positions), *surfaces, *size, unconnected, marked, crease_weights, *found)

    def add(self, slot: UInt32, here: UInt32, there: UInt32, soft: Float, cross: Callable[[Bool], Bool]) -> None:
        """List a pair if the triangles that its pixels see may intersect. To be traced only once.

        Args:
            slot: slot of the pair in the list of all pairs.
            here, there: triangles that its pixels see; ``NO_TRIANGLE`` if there is none, or if the pair has an edge.
            soft: weight of creases there.
            cross: ``cross(active)`` is True if a surface may cut itself between the pixels, by the planes of the triangles.
        """
        UInt32 = backend(slot).UInt32
        both = (here != NO_TRIANGLE) & (there != NO_TRIANGLE)
        apart = dr.gather(UInt32, self.parts, here, both) != dr.gather(UInt32, self.parts, there, both)
        folded = (soft > 0) & (self.marked is not None)
        listed = both & dr.select(apart, self.unconnected, folded)
        if self.unconnected:
            listed |= cross(both & ~listed)
        dr.scatter(self.slots, slot, scatter_inc(self.count, UInt32(0), listed), listed)
        dr.scatter(self.here, here, slot, listed)
        dr.scatter(self.there, there, slot, listed)

    def for_each(self, visit: Callable[[UInt32], None]) -> None:
        """Call ``visit(slot)``, which scatters its results, for all listed pairs: few, but each is expensive."""
        each_number(self.count, _LANES, lambda k: visit(dr.gather(type(k), self.slots, k)))

    def weights(self, slot: UInt32, pixel: UInt32, down: Bool) -> tuple[Float, Float]:
        """Weights of listed pairs, and their change with the first pixel's depth minus the second's.

        Both are 0 where the triangles do not intersect in between. Weights are signed (see :class:`Crossings`).
        """
        cut = self._cut(slot, pixel, down)
        # Weight of ridges and valleys; smooth surfaces have none.
        soft = self.module.Float(0 if self.marked is None else 1)
        parts = [dr.gather(self.module.UInt32, self.parts, triangle) for triangle in cut.triangles]
        for p, triangle in zip(cut.pixels, cut.triangles, strict=True):
            if self.marked is not None:
                weight = 1 if self.crease_weights is None else dr.gather(self.module.Float, self.crease_weights, p)
                flat = (self.marked.at(triangle) & 7) == 7  # creases on all sides
                soft = dr.minimum(soft, dr.select(flat, weight, 0))
        a, b, _ = cut.difference
        start, change = cut.start, cut.change
        end = start + change
        first = cut.planes[0]
        depth = first[0] * cut.x + first[1] * cut.y + first[2]
        # Of two surfaces the nearer one is visible. Faces of one surface form a ridge or a valley.
        folded = parts[0] == parts[1]
        steepness = sum(dr.abs(cut.along(plane)) for plane in cut.planes)
        least = dr.maximum(_LEAST_CHANGE * dr.abs(depth), dr.select(folded, _LEAST_FOLD * steepness, 0))
        meet = (((start < 0) & (end > 0)) | (folded & (start > 0) & (end < 0))) & (dr.abs(change) > least)
        slope = dr.select(meet, precise_rcp(dr.select(meet, change, 1)), 0)
        t = -start * slope
        across = (a * cut.step_x) ** 2
        upwards = (b * cut.step_y) ** 2
        soft *= self.module.Float(dr.clip(2 - self._bent(cut) / (_BENT * dr.select(meet, dr.abs(change), 1)), 0, 1))
        # If the point lies inside both triangles, one passes through the other, whatever the adjacent faces are.
        inside = start < 0
        for places in cut.barycentrics(t):
            inside &= functools.reduce(dr.minimum, places) > _INSIDE * sum(places)
        soft = dr.select(inside, 1, soft)
        share = dr.clip(0.5 + (across - upwards) / dr.select(meet, across + upwards, 1), 0, 1)
        share = dr.select(meet, dr.select(down, 1 - share, share) * dr.select(folded, soft, 1), 0)
        return self.module.Float(share) * beyond_middle(self.module.Float(t)), self.module.Float(-share * slope)

    def slopes(self, slot: UInt32, pixel: UInt32, down: Bool, rate: Float) -> list[tuple[UInt32, Vector4f]]:
        """(vertex, derivative of the weight by its clip-space position) for all six vertices of pairs that have a weight.

        ``rate``: change of the weight with the depth, see :meth:`weights`.
        """
        module, cut = self.module, self._cut(slot, pixel, down)
        t = -cut.start * precise_rcp(dr.select(cut.change != 0, cut.change, 1))
        result = []
        for k, (sign, weights) in enumerate(zip((1, -1), cut.barycentrics(t), strict=True)):
            # A x + B y + C w = z holds for each corner: the change of the plane balances that of the corner.
            plane = [module.Float(v) for v in cut.planes[k]]
            direction = module.Array4f(-plane[0], -plane[1], 1, -plane[2])
            result += [(cut.vertices[k][n], direction * (sign * rate * weights[n])) for n in range(3)]
        return result

    @property
    def module(self) -> ModuleType:
        """Module of the arrays' types."""
        return backend(self.positions)

    def _cut(self, slot: UInt32, pixel: UInt32, down: Bool) -> _Cut:
        """The planes of the triangles of listed pairs, and where they cross in between."""
        module = self.module
        image, row, column = by_pixel(pixel, self.batch, self.height, self.width)
        first = image * uint_input(module, "vertices", self.vertex_count)
        # Centre of the pixel, and the offset of its neighbour, in NDC.
        x, y = exact_centres(module, row, column, self.height, self.width)
        step_x, step_y = double_input(module, "width", 2 / self.width), double_input(module, "height", 2 / self.height)
        pixels = pixel, pixel + dr.select(down, uint_input(module, "width", self.width), 1)
        triangles = [dr.gather(module.UInt32, triangles, slot) for triangles in (self.here, self.there)]
        found = [_plane(gather_triangle(self.positions, self.faces, triangle, first, True)) for triangle in triangles]
        indices = [dr.gather(module.Array3u, self.faces, triangle) for triangle in triangles]
        vertices = [[first + i[k] for k in range(3)] for i in indices]
        lines, planes = [lines for lines, _ in found], [plane for _, plane in found]
        a, b, c = (u - v for u, v in zip(*planes, strict=True))
        start, change = dr.fma(a, x, dr.fma(b, y, c)), dr.select(down, b * step_y, a * step_x)
        return _Cut(pixels, triangles, vertices, first, lines, planes, (a, b, c), x, y, step_x, step_y, down, start, change)

    def _bent(self, cut: _Cut) -> Float64:
        """Largest deviation of both triangles' adjacent faces from both planes, as change of depth from pixel to neighbour.

        At a ridge, the adjacent face lies in one of the two planes.
        """
        module = self.module
        slopes = [cut.along(plane) for plane in cut.planes]

        # A loop, since six faces written out take several times as long to compile.
        def look(number, most, triangle, other, first, down, step_x, step_y, slope, slope_2):  # noqa: ANN001, ANN202
            second = number >= 3
            k = dr.select(second, number - 3, number)
            face = 3 * dr.select(second, other, triangle)
            vertex = dr.gather(module.UInt32, self.beyond, face + k)
            has = vertex != NO_VERTEX
            ends = (dr.gather(module.UInt32, self.faces, face + corner) for corner in (k, dr.select(k == 2, 0, k + 1)))
            active = [module.Bool(True)] * 2 + [has]
            corners = tuple(
                dr.gather(module.Array4f, self.positions, first + v, a) for v, a in zip((*ends, vertex), active, strict=True)
            )
            plane = _plane(cast("Corners", corners))[1]
            own = dr.select(down, plane[1] * step_y, plane[0] * step_x)
            apart = dr.minimum(dr.abs(own - slope), dr.abs(own - slope_2))
            most = dr.maximum(most, dr.select(has, apart, 0))
            return number + 1, most, triangle, other, first, down, step_x, step_y, slope, slope_2

        lanes = dr.width(cut.triangles[0])
        state = (
            dr.zeros(module.UInt32, lanes),
            dr.zeros(module.Float64, lanes),
            *(*cut.triangles, cut.first, cut.down, cut.step_x, cut.step_y, *slopes),
        )
        found = dr.while_loop(state, lambda number, *_: number < 6, look, mode="symbolic", label="adjacent faces")
        return cast("Float64", found[1])


@dataclass(frozen=True)
class _Cut:
    """Triangles that pixels and their neighbours see, and the difference of the depths of their planes in between.

    Attributes:
        pixels, triangles, vertices, lines, planes: of the pixel, then of its neighbour. Barycentrics / w (``lines``) and depths
            are affine functions in NDC.
        first: first vertex of the image.
        difference: first plane minus the second one.
        x, y, step_x, step_y: centre of the pixel and offsets of its neighbours, in NDC.
        down: True if the neighbour is the lower one.
        start, change: difference at the pixel, and its change from there to the neighbour.
    """

    pixels: tuple[UInt32, UInt32]
    triangles: list[UInt32]
    vertices: list[list[UInt32]]
    first: UInt32
    lines: list[list[Line]]
    planes: list[Line]
    difference: Line
    x: Float64
    y: Float64
    step_x: Float64
    step_y: Float64
    down: Bool
    start: Float64
    change: Float64

    def along(self, plane: Line) -> Float64:
        """Change of depth on a plane from the pixel to its neighbour."""
        return dr.select(self.down, plane[1] * self.step_y, plane[0] * self.step_x)

    def barycentrics(self, t: Float64) -> list[list[Float]]:
        """Barycentrics / w in both triangles of the point at ``t`` (0 to 1) between the pixels' centres."""
        Float = backend(t).Float
        x = dr.select(self.down, self.x, self.x + t * self.step_x)
        y = dr.select(self.down, self.y + t * self.step_y, self.y)
        return [[Float(dr.fma(m, x, dr.fma(n, y, o))) for m, n, o in lines] for lines in self.lines]


def beyond_middle(t: Float) -> Float:
    """Signed distance (pixels) from the border between two pixels, of a point at ``t`` (0 to 1) between their centres.

    Never 0: see ``LEAST_WEIGHT``.
    """
    return dr.select(t == 0.5, LEAST_WEIGHT, t - 0.5)


def _plane(corners: Corners) -> tuple[list[Line], Line]:
    """Barycentrics / w of a triangle, and its depth, as affine functions (a, b, c: a x + b y + c) in NDC."""
    lines, det = edge_lines(corners)
    inverse = dr.select(det != 0, precise_rcp(dr.select(det != 0, det, 1)), 0)
    lines = [(a * inverse, b * inverse, c * inverse) for a, b, c in lines]
    return lines, cast(
        Line, tuple(sum(line[c] * type(det)(p.z) for line, p in zip(lines, corners, strict=True)) for c in range(3))
    )

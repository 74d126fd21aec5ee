"""Jumps of colours at an edge between two pixels, estimated from the pixels on both sides.

The difference of the colours at the pixels' centres is not the jump at the edge: it includes the change of shading up to the
edge, which would count twice when the edge moves. So the colours of both sides are extrapolated linearly to the edge, with the
slope between each pixel and the next one behind it. Only derivatives use these colours; blended values do not.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr

from ...jit.arrays import backend
from ...jit.kernel_inputs import double_input, uint_input
from ...jit.types import Bool, Float, UInt32
from ..topology import Topology
from ..triangle_setup import edge_lines, exact_centres, gather_triangle
from ..types import NO_TRIANGLE, RasterOutput, by_pixel
from .creases import MarkedFaces, touching


@dataclass(frozen=True)
class Surroundings:
    """Inputs of the test whether colours change continuously from a pixel to its neighbour. Detached.

    Attributes:
        triangle: triangle that each pixel sees.
        positions: flat clip-space vertices (4 V B), as rasterized.
        topology: topology of the mesh.
        marked: edges of faces at which colours jump, or None.
        sharpness: for each pixel, or None for 1. It is 1 where flat faces are large enough to show their own colours, 0 where
            they are so small that they show the colours of a smooth surface. In between, colours are partly random and are not
            extrapolated.
        batch: number of images.
        height, width, vertex_count: of an image.
    """

    triangle: UInt32
    positions: Float
    topology: Topology
    marked: MarkedFaces | None
    sharpness: Float | None
    batch: int
    height: int
    width: int
    vertex_count: int

    @classmethod
    def of(
        cls,
        raster: RasterOutput,
        positions: Float,
        topology: Topology,
        marked: MarkedFaces | None,
        sharpness: Float | None,
    ) -> Surroundings:
        """For flat positions; sharpness as ``crease_weights`` of :func:`find_crossings`."""
        positions, sharpness = dr.detach(positions), None if sharpness is None else dr.detach(sharpness)
        size = raster.batch, raster.height, raster.width, dr.width(positions) // (4 * raster.batch)
        return cls(raster.triangle, positions, topology, marked, sharpness, *size)

    def beyond(
        self,
        read: Callable[[UInt32, Bool | bool], list[Float]],
        crossed: Callable[[UInt32, Bool, Bool], Bool],
        taker: UInt32,
        giver: UInt32,
        down: Bool,
        place: Float,
        active: Bool | bool = True,
    ) -> list[Float]:
        """Colours of pixels plus the jump to their neighbours' colours at an edge in between.

        Both colours are extrapolated to the edge, if the next pixel behind them sees the same surface. In each channel, the jump
        has the sign of the difference between the pixels, and is at most twice as large.

        Args:
            read: ``read(pixel, active)`` returns the channels of pixels.
            crossed: ``crossed(pixel, down, active)`` is True if an edge lies between a pixel and its right (lower) neighbour.
            taker, giver: pixels, and neighbours that reach into them.
            down: True if the neighbours lie above or below.
            place: position of the edge, from 0 at the taker's centre to 1 at the giver's.
        """
        module = backend(place)
        own, other = read(taker, active), read(giver, active)
        step = dr.select(down, uint_input(module, "width", self.width), 1)
        forward = giver > taker
        slopes = []
        for near, values, sign in ((taker, own, -1), (giver, other, 1)):
            ahead = forward if sign > 0 else ~forward
            far = dr.select(ahead, near + step, near - step)
            steady = self._steady(crossed, near, far, down, ahead, self._inside(near, down, ahead, active))
            slopes.append([dr.select(steady, sign * (f - v), 0) for f, v in zip(read(far, steady), values, strict=True)])
        result = []
        for o, v, slope, other_slope in zip(own, other, *slopes, strict=True):
            jump = v - o
            continued = dr.fma(other_slope, place - 1, dr.fma(-slope, place, jump))
            result.append(o + dr.clip(continued, dr.minimum(2 * jump, 0), dr.maximum(2 * jump, 0)))
        return result

    def _inside(self, pixel: UInt32, down: Bool, ahead: Bool, active: Bool | bool) -> Bool:
        """True if the next pixel to the right (left, if not ``ahead``) or below (above) belongs to the same image."""
        module = backend(pixel)
        _, row, column = by_pixel(pixel, self.batch, self.height, self.width)
        at = dr.select(down, row, column)
        last = dr.select(down, uint_input(module, "height", self.height - 1), uint_input(module, "width", self.width - 1))
        return dr.select(ahead, at < last, at > 0) & active

    def _steady(
        self, crossed: Callable[[UInt32, Bool, Bool], Bool], near: UInt32, far: UInt32, down: Bool, ahead: Bool, inside: Bool
    ) -> Bool:
        """True if pixels and their neighbours see the same triangle, or triangles of one smooth surface.

        It does not suffice that no edge crosses the segment between the pixels: edges along the segment are not counted there.
        """
        module = backend(near)
        here, there = (dr.gather(module.UInt32, self.triangle, pixel, inside) for pixel in (near, far))
        inside = inside & (here != NO_TRIANGLE) & (there != NO_TRIANGLE)
        same, smooth, soft = inside & (here == there), inside & (here != there), module.Bool(False)
        if self.sharpness is not None:
            sharp, far_sharp = (dr.gather(module.Float, self.sharpness, pixel, inside) for pixel in (near, far))
            soft = (sharp == 0) & (far_sharp == 0)
            same &= (sharp == 1) | soft
        part, other = (dr.gather(module.UInt32, self.topology.parts, triangle, smooth) for triangle in (here, there))
        smooth &= part == other
        smooth &= ~crossed(dr.select(ahead, near, far), down, smooth)
        marked = self.marked
        if marked is None:
            return same | smooth

        def unbroken(near: UInt32, far: UInt32, down: Bool, ahead: Bool, here: UInt32, there: UInt32, soft: Bool) -> Bool:
            if marked.folds is not None:
                soft |= touching(self.topology, here, there) & marked.folds.flat(here, there)
            marks = marked.at(here), marked.at(there)
            jumps = [[marked.crease(mark, k, soft) for k in range(3)] for mark in marks]
            none = ~functools.reduce(operator.or_, jumps[0] + jumps[1])
            open_ = ~(jumps[0][0] & jumps[0][1] & jumps[0][2]) & ~(jumps[1][0] & jumps[1][1] & jumps[1][2])

            def on_the_way(
                near: UInt32, far: UInt32, down: Bool, ahead: Bool, here: UInt32, there: UInt32, soft: Bool,
                mark: UInt32, other: UInt32, none: Bool,
            ) -> Bool:  # fmt: skip
                way_out, way_in = self._way_out(near, here, down, ahead), self._way_out(far, there, down, ~ahead)
                return ~marked.crease(mark, way_out, soft) & ~marked.crease(other, way_in, soft)

            # Few triangles have creases at only some of their edges.
            lanes = near, far, down, ahead, here, there, soft, *marks, none
            return dr.if_stmt(lanes, open_ & ~none, on_the_way, lambda *lanes: lanes[-1], mode="symbolic", label="rims")

        lanes = near, far, down, ahead, here, there, soft
        return same | dr.if_stmt(lanes, smooth, unbroken, lambda *_: module.Bool(False), mode="symbolic", label="smooth")

    def _way_out(self, pixel: UInt32, triangle: UInt32, down: Bool, ahead: Bool) -> UInt32:
        """Edge (0 to 2) through which a ray from a pixel's centre towards a neighbour leaves the triangle."""
        module = backend(pixel)
        Float64 = module.Float64
        image, row, column = by_pixel(pixel, self.batch, self.height, self.width)
        first = image * uint_input(module, "vertices", self.vertex_count)
        lines, det = edge_lines(gather_triangle(self.positions, self.topology.faces, triangle, first, True))
        x, y = exact_centres(module, row, column, self.height, self.width)
        per_column, per_row = double_input(module, "width", 1 / self.width), double_input(module, "height", 1 / self.height)
        sign = dr.select((det < 0) == ahead, 1, -1)
        nearest, edge = Float64(dr.inf), module.UInt32(0)
        for k, (a, b, c) in enumerate(lines):
            # Distance from the edge opposite to a corner, in any unit, and its decrease along the ray.
            value, rate = dr.abs(dr.fma(a, x, dr.fma(b, y, c))), sign * dr.select(down, b * per_row, a * per_column)
            distance = dr.select(rate > 0, value / rate, dr.inf)
            edge = dr.select(distance < nearest, (k + 1) % 3, edge)
            nearest = dr.minimum(nearest, distance)
        return edge

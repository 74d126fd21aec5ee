"""Creases between neighbouring pixels: edges at which no surface ends, but its colour jumps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from ._types import NO_TRIANGLE, RasterOutput, backend
from .topology import Topology


@dataclass(frozen=True)
class Crease:
    """An edge for each pair of pixels: whether there is one, and (end points, share) as in :class:`Crossings`."""

    found: Any
    edge: tuple[Any, Any, Any]


def find_creases(
    creases: Any,
    weights: Any,
    positions: Any,
    topology: Topology,
    vertex_count: int,
    raster: RasterOutput,
    pixel: Any,
    pairs: Any,
    down: int,
) -> tuple[Crease, Crease]:
    """Creases between pixels and their right (``down`` = 0) or lower (1) neighbours, where ``pairs`` asks for them.

    Two triangles of one surface have a corner in common, if they are not much smaller than a pixel. Through one edge one
    leaves the first on the way to the neighbour, through one (the same, as a rule) one enters the other. If they are two, other
    faces of unknown colour lie in between, about the mean of both: each edge then counts half.

    Args:
        creases, weights: see :func:`find_crossings`.
        pixel: the pixels that the lanes work on (:func:`block_pixels`).
    """
    module = backend(pixel.row)
    index, image = pixel.index, pixel.image
    step = raster.width if down else 1
    here = dr.gather(module.UInt32, raster.triangle, index, pairs)
    neighbour = dr.gather(module.UInt32, raster.triangle, index + step, pairs)
    near = _touch(topology, here, neighbour, pairs)
    x = module.Float(pixel.column) + (0.5 - 0.5 * raster.width)
    y = module.Float(pixel.row) + (0.5 - 0.5 * raster.height)
    corner_out = _way_out(raster, image, here, x, y, down, 1, near)
    corner_in = _way_out(raster, image, neighbour, x + (1 - down), y + down, down, -1, near)
    hard_out = near & dr.gather(module.Bool, creases, 3 * here + corner_out, near)
    hard_in = near & dr.gather(module.Bool, creases, 3 * neighbour + corner_in, near)
    weight = dr.select(hard_out & hard_in, 0.5, module.Float(1))
    if weights is not None:
        weight *= dr.minimum(*(dr.gather(module.Float, weights, index + k, near) for k in (0, step)))
    result = []
    for face, corner, found in ((here, corner_out, hard_out), (neighbour, corner_in, hard_in)):
        a, b = (dr.gather(module.UInt32, topology.faces, 3 * face + k, found) for k in (corner, _next(corner)))
        share = _horizontal_share(positions, image * vertex_count, a, b, found, raster)
        result.append(Crease(found, (a, b, weight * (1 - share if down else share))))
    return result[0], result[1]


def _touch(topology: Topology, first: Any, second: Any, active: Any) -> Any:
    """Whether two faces (or none) have a corner in common."""
    module = backend(first)
    active = active & (first != NO_TRIANGLE) & (second != NO_TRIANGLE)
    mine = dr.gather(module.Array3u, topology.welded, first, active)
    other = dr.gather(module.Array3u, topology.welded, second, active)
    common = module.Bool(False)
    for k in range(3):
        common |= (mine[k] == other.x) | (mine[k] == other.y) | (mine[k] == other.z)
    return active & common


def _way_out(raster: RasterOutput, image: Any, triangle: Any, x: Any, y: Any, axis: int, sign: int, active: Any) -> Any:
    """Corner at which the edge starts through which one leaves a triangle from a point inside, along an axis of the image."""
    module = backend(x)
    lines = raster.edge_functions(image, triangle, active)
    value = dr.fma(lines[0], x, dr.fma(lines[1], y, lines[2]))
    nearest, opposite = module.Float(dr.inf), module.UInt32(0)
    for k in range(3):
        slope = lines[axis][k] * -sign
        distance = dr.select(slope > 0, dr.maximum(value[k], 0) / slope, dr.inf)
        opposite = dr.select(distance < nearest, k, opposite)
        nearest = dr.minimum(nearest, distance)
    return _next(opposite)


def _next(corner: Any) -> Any:
    return dr.select(corner == 2, 0, corner + 1)


def _horizontal_share(positions: Any, first: Any, a: Any, b: Any, active: Any, raster: RasterOutput) -> Any:
    """Share of horizontal pairs in an edge, from its direction in the image (of its line, if it reaches behind the camera)."""
    module = backend(positions)
    p, q = (dr.gather(module.Array4f, positions, first + v, active) for v in (a, b))
    # The line a x + b y + c = 0 in ndc is a (2 / width) x + ... in pixels.
    nx, ny = (p.y * q.w - q.y * p.w) / raster.width, (q.x * p.w - p.x * q.w) / raster.height
    square = nx * nx + ny * ny
    return dr.clip(0.5 + (nx * nx - ny * ny) / dr.select(square > 0, square, 1), 0, 1)

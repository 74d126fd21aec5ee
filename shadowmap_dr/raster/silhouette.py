"""Where silhouettes cross the image: for each pair of neighbouring pixels, the mesh edge that separates them.

The usual scheme looks for the separating edge among the three of the triangle that a pixel sampled, which fails once
triangles are smaller than pixels. Here the silhouette edges of the whole mesh are found first, sorted into the rasterizer's
pyramid of grids, and each pixel pair looks through the lists of its cell.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr

from ._types import NO_TRIANGLE, RasterOutput, backend, pixel_coordinates
from .creases import find_creases
from .grid import CellLists, GridShape, block_pixels, build_cell_lists
from .topology import NO_VERTEX, Topology

#: Entry of :class:`Crossings` for a pair of pixels that no silhouette separates.
NO_EDGE = 0xFFFFFFFF

# An edge must lie this far (relative, and absolute in NDC depth) before the surface that it borders: it is a
# discontinuity, not a crease. The relative part suits depths that are reciprocal in distance.
_DEPTH_GAP = 1e-5
_DEPTH_GAP_ABSOLUTE = 2e-7


@dataclass(frozen=True)
class Crossings:
    """Edges that separate each pixel from its right and lower neighbour.

    ``right_a``, ``right_b``, ``down_a``, ``down_b`` (``UInt32``) are the end points of the edge, ``NO_EDGE`` where there is none.
    ``right_share``, ``down_share`` weight the pair: an edge steeper than 60 degrees counts for horizontal pairs only, one flatter
    than 30 degrees for vertical pairs only, so that the two directions together blend each piece of outline once. No gradients.
    ``second``: further edges between the same pixels, with shares of their own, or None.
    """

    right_a: Any
    right_b: Any
    down_a: Any
    down_b: Any
    right_share: Any
    down_share: Any
    second: Crossings | None = None


def find_crossings(
    positions: Any,
    topology: Topology,
    raster: RasterOutput,
    vertex_count: int,
    creases: Any = None,
    crease_weights: Any = None,
) -> Crossings:
    """Find the edge between each pair of neighbouring pixels.

    Args:
        positions: flat clip-space vertices (4 V B), as rasterized.
        topology: edges of the mesh.
        raster: output of the rasterizer for the same vertices.
        vertex_count: vertices per image, V.
        creases: ``Bool`` (3 F,), whether the edge from corner k to k + 1 of a face separates pixels that see its two faces, too
            (between flat-shaded ones, whose colours jump there).
        crease_weights: ``Float`` for each pixel, between 0 and 1: how much creases count there; 1 if not given.

    A silhouette is an edge whose faces all lie on one side of it in the image. It separates two pixels that see different
    triangles when it crosses the segment between their centres and lies before the surface that the uncovered one sees
    (extended to the crossing). Among several the outermost is taken: up to it the uncovered pixel's surface is hidden.

    Between two pixels whose triangles touch, the edges through which one leaves the first triangle and enters the other are
    creases. If these are two edges, with something unseen in between, each counts half.
    """
    with dr.suspend_grad():
        positions = dr.detach(positions)
        shape = GridShape(raster.batch, raster.height, raster.width)
        records, image, box, active = _set_up(positions, topology, vertex_count, shape)
        lists = build_cell_lists(shape, image, box, active)
        return _search(lists, records, positions, topology, vertex_count, raster, creases, crease_weights)


def _set_up(
    positions: Any, topology: Topology, vertex_count: int, shape: GridShape
) -> tuple[Any, Any, tuple[Any, Any, Any, Any], Any]:
    """Clipped, projected end points of all edges: (x, y, z, side) and (x, y, z, share); which are silhouettes; pixel boxes."""
    module = backend(positions)
    Float, UInt32, Int32, Array4f, Array2u = module.Float, module.UInt32, module.Int32, module.Array4f, module.Array2u
    index = dr.arange(UInt32, shape.batch * topology.count)
    image = index // topology.count
    edge = index - image * topology.count
    ends, opposite = dr.gather(Array2u, topology.edges, edge), dr.gather(Array2u, topology.opposite, edge)
    first = image * vertex_count
    a, b = (dr.gather(Array4f, positions, first + ends[k]) for k in range(2))
    # Orientation is compared, not measured: the cross product is taken around one end point to keep small triangles exact.
    sides = []
    for k in range(2):
        exists = opposite[k] != NO_VERTEX
        o = dr.gather(Array4f, positions, first + opposite[k], exists)
        sides.append(dr.select(exists, _orientation(a, b, o), 0))
    same = sides[0] * sides[1]
    side = dr.select(sides[0] != 0, sides[0], sides[1])
    active = (same >= 0) & (side != 0)

    near_a, near_b = a.z + a.w, b.z + b.w
    active &= (near_a > 0) | (near_b > 0)

    def clip(p: Any, q: Any, near_p: Any, near_q: Any) -> Any:
        s = near_p / dr.select(near_p < 0, near_p - near_q, 1)
        return dr.select(near_p < 0, dr.fma(q - p, s, p), p)

    a, b = clip(a, b, near_a, near_b), clip(b, a, near_b, near_a)
    active &= (a.w > 0) & (b.w > 0)

    def project(p: Any) -> tuple[Any, Any, Any]:
        inv = dr.rcp(dr.select(active, p.w, 1))
        return p.x * inv * (0.5 * shape.width), p.y * inv * (0.5 * shape.height), p.z * inv

    (ax, ay, az), (bx, by, bz) = project(a), project(b)
    active &= dr.isfinite(ax + ay + bx + by)
    dx, dy = dr.select(active, bx - ax, 0), dr.select(active, by - ay, 0)
    square = dx * dx + dy * dy
    share = dr.clip(0.5 + (dy * dy - dx * dx) / dr.select(square > 0, square, 1), 0, 1)

    # Pair (i, i + 1) contains abscissa x where floor(x - 1/2) = i.
    def first_pixel(v: Any, size: int) -> Any:
        return Int32(dr.floor(dr.clip(dr.select(active, v, 0) + (0.5 * size - 0.5), -2.0, size + 1.0)))

    m = 1.0 / 512.0
    raw = (
        first_pixel(dr.minimum(ax, bx) - m, shape.width),
        first_pixel(dr.minimum(ay, by) - m, shape.height),
        first_pixel(dr.maximum(ax, bx) + m, shape.width),
        first_pixel(dr.maximum(ay, by) + m, shape.height),
    )
    # An edge that meets no line through pixel centres crosses no pair at all.
    active &= (raw[0] < raw[2]) & (share < 1) | (raw[1] < raw[3]) & (share > 0)
    box = (
        dr.maximum(raw[0], 0),
        dr.maximum(raw[1], 0),
        dr.minimum(raw[2], shape.width - 1),
        dr.minimum(raw[3], shape.height - 1),
    )
    active &= (box[0] <= box[2]) & (box[1] <= box[3])
    records = dr.empty(Float, 8 * shape.batch * topology.count)
    dr.scatter(records, Array4f(ax, ay, az, side), 2 * index, active)
    dr.scatter(records, Array4f(bx, by, bz, share), 2 * index + 1, active)
    dr.eval(records, box, active)
    return records, image, box, active


def _orientation(a: Any, b: Any, o: Any) -> Any:
    """Sign of the determinant of three homogeneous (x, y, w) points, in double precision."""
    Float64 = backend(a).Float64
    ax, ay, aw = Float64(a.x), Float64(a.y), Float64(a.w)
    bx, by, bw = Float64(b.x), Float64(b.y), Float64(b.w)
    det = (ay * bw - by * aw) * Float64(o.x) + (bx * aw - ax * bw) * Float64(o.y) + (ax * by - bx * ay) * Float64(o.w)
    return backend(a).Float(dr.select(det == 0, 0, dr.sign(det)))


def _search(
    lists: CellLists,
    records: Any,
    positions: Any,
    topology: Topology,
    vertex_count: int,
    raster: RasterOutput,
    creases: Any,
    crease_weights: Any,
) -> Crossings:
    module = backend(records)
    Float, UInt32 = module.Float, module.UInt32
    shape = lists.shape
    pixel = block_pixels(shape, module)
    image, index = pixel.image, pixel.index

    here = dr.gather(UInt32, raster.triangle, index, pixel.inside)
    open_right = pixel.inside & (pixel.column + 1 < shape.width)
    open_down = pixel.inside & (pixel.row + 1 < shape.height)
    right = dr.gather(UInt32, raster.triangle, index + 1, open_right)
    below = dr.gather(UInt32, raster.triangle, index + shape.width, open_down)
    open_right &= here != right
    open_down &= here != below
    planes = [_depth_plane(raster, image, t) for t in (here, right, below)]

    def visit(edge, row, column, edge_right, reach_right, share_right, edge_down, reach_down, share_down):  # noqa: ANN001, ANN202
        x = Float(column) + (0.5 - 0.5 * shape.width)
        y = Float(row) + (0.5 - 0.5 * shape.height)
        p = dr.gather(module.Array4f, records, 2 * edge)
        q = dr.gather(module.Array4f, records, 2 * edge + 1)
        side, share = p.w, q.w

        ok, reach = _separates(p, q, side, 0, x, y, planes[0], planes[1])
        better = ok & open_right & (share > 0) & _wins(reach, edge, reach_right, edge_right)
        edge_right = dr.select(better, edge, edge_right)
        reach_right = dr.select(better, reach, reach_right)
        share_right = dr.select(better, share, share_right)

        ok, reach = _separates(p, q, -side, 1, y, x, planes[0], planes[2])
        better = ok & open_down & (share < 1) & _wins(reach, edge, reach_down, edge_down)
        edge_down = dr.select(better, edge, edge_down)
        reach_down = dr.select(better, reach, reach_down)
        share_down = dr.select(better, 1 - share, share_down)
        return edge_right, reach_right, share_right, edge_down, reach_down, share_down

    none, start = UInt32(NO_EDGE), (UInt32(NO_EDGE), Float(-1), Float(0))
    edge_right, _, share_right, edge_down, _, share_down = lists.walk(pixel, start + start, visit, open_right | open_down)

    first = image * topology.count
    ends, seconds = [], []
    for edge, share, is_open, down in ((edge_right, share_right, open_right, 0), (edge_down, share_down, open_down, 1)):
        found = edge != NO_EDGE
        ab = dr.gather(module.Array2u, topology.edges, edge - first, found)
        end = (dr.select(found, ab.x, none), dr.select(found, ab.y, none), share)
        if creases is not None:
            pairs = is_open & ~found
            near, far = find_creases(creases, crease_weights, positions, topology, vertex_count, raster, pixel, pairs, down)
            end = tuple(dr.select(near.found, new, old) for new, old in zip(near.edge, end, strict=True))
            seconds.append(tuple(dr.select(far.found, new, old) for new, old in zip(far.edge, (none, none, 0), strict=True)))
        ends.append(end)

    def in_rows(values: list[tuple[Any, Any, Any]]) -> Crossings:
        (ra, rb, right_share), (da, db, down_share) = values
        result = []
        for value in (ra, rb, da, db, right_share, down_share):
            out = dr.empty(type(value), shape.batch * shape.height * shape.width)
            dr.scatter(out, value, index, pixel.inside)
            result.append(out)
        return Crossings(*result)

    crossings = in_rows(ends)
    if seconds:
        crossings = replace(crossings, second=in_rows(seconds))
    dr.eval(crossings)
    return crossings


def _separates(p: Any, q: Any, side: Any, along: int, start: Any, fixed: Any, here: Any, neighbour: Any) -> tuple[Any, Any]:
    """Does a projected edge separate the pair of pixels from ``start`` to ``start + 1`` along an axis? How far does it cover?

    ``here`` and ``neighbour`` are the depth planes of what the two see; ``side`` tells on which side of the edge its surface is.
    """
    across = 1 - along
    extent = q[across] - p[across]
    s = (fixed - p[across]) / dr.select(extent == 0, 1, extent)
    crossing = dr.fma(s, q[along] - p[along], p[along])
    z = dr.fma(s, q.z - p.z, p.z)
    t = crossing - start
    covers_start = side * extent > 0
    x, y = (crossing, fixed) if along == 0 else (fixed, crossing)
    hidden = dr.select(covers_start, neighbour(x, y), here(x, y))
    gap = dr.fma(dr.abs(hidden), _DEPTH_GAP, _DEPTH_GAP_ABSOLUTE)
    ok = (extent != 0) & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1) & (z < hidden - gap)
    return ok, dr.select(covers_start, t, 1 - t)


def _wins(reach: Any, candidate: Any, best_reach: Any, best: Any) -> Any:
    """Outermost first; equal ones by their number, so that the result does not depend on the order of the lists."""
    return (reach > best_reach) | ((reach == best_reach) & (candidate < best))


def _depth_plane(raster: RasterOutput, image: Any, triangle: Any) -> Any:
    """NDC depth of a triangle's plane as a function of centred pixel coordinates; the far plane where there is none."""
    hit = triangle != NO_TRIANGLE
    dx, dy, d = raster.depth_plane(image, triangle, hit)
    d = dr.select(hit, d, 1)
    return lambda x, y: dr.fma(dx, x, dr.fma(dy, y, d))


def crossing_position(positions: Any, raster: RasterOutput, ends: tuple[Any, Any], vertex_count: int, down: bool) -> Any:
    """Where an edge crosses the line from each pixel's centre to its right (or lower) neighbour, in pixels from the former.

    Attached to ``positions``; 1/2 where there is no edge. The homogeneous form is valid, in value and derivative, for edges
    that reach behind the camera.
    """
    module = backend(positions)
    image, row, column = pixel_coordinates(module, raster.batch, raster.height, raster.width)
    has = ends[0] != NO_EDGE
    a, b = (dr.gather(module.Array4f, positions, image * vertex_count + ends[k], has) for k in range(2))
    # The pixel line is y = const (x = const for the lower neighbour) in NDC.
    along, across = ("y", "x") if down else ("x", "y")
    start, size = (row, raster.height) if down else (column, raster.width)
    fixed, fixed_size = (column, raster.width) if down else (row, raster.height)
    ndc = dr.fma(module.Float(fixed), 2.0 / fixed_size, 1.0 / fixed_size - 1.0)
    da = dr.fma(-a.w, ndc, getattr(a, across))
    db = dr.fma(-b.w, ndc, getattr(b, across))
    span = da - db
    s = da / dr.select(has & (span != 0), span, 1)
    w = dr.fma(s, b.w - a.w, a.w)
    value = dr.fma(s, getattr(b, along) - getattr(a, along), getattr(a, along)) / dr.select(has & (w != 0), w, 1)
    t = dr.fma(value, 0.5 * size, 0.5 * size - 0.5) - module.Float(start)
    return dr.select(has, dr.clip(t, 0, 1), 0.5)

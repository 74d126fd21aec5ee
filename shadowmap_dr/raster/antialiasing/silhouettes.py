"""Crossings of silhouettes in the image: for each pair of neighbouring pixels, the mesh edge that separates them.

The usual scheme looks for the separating edge among the three of the triangle that a pixel sampled, which fails once
triangles are smaller than pixels. Here each silhouette edge of the whole mesh walks along the lines through pixel centres
that it crosses, and registers with the pairs of pixels that it separates; the outermost edge of a pair wins.
"""

from __future__ import annotations

import drjit as dr

from ...jit.arrays import backend, reinterpret, scatter_inc
from ...jit.kernel_inputs import float_input, int_input, split, uint_input
from ...jit.types import Bool, Float, UInt32, UInt64, Vector3f, Vector4f
from ..topology import NO_VERTEX, Topology
from ..triangle_setup import beside
from ..types import NO_TRIANGLE, RasterOutput
from .pixel_pairs import PairList

# An edge must lie this far (relative) before the surface behind it to count as a discontinuity.
_RELATIVE_GAP = 1e-5
#: Bit in the keys of such edges. Edges without it belong to a surface that lies on another one.
BEFORE = 1 << 62
# Margin for rounding: lines through pixel centres up to this far (in pixels) beyond an edge's ends are tested, too.
_MARGIN = 1.0 / 512.0
# Lanes that walk along the silhouettes of an image. Few, so that threads get equal parts even of a short list.
_LANES, _LANES_PER_EDGE = 512, 4
_MOST_LANES = 32768


def register_silhouettes(
    positions: Float,
    topology: Topology,
    raster: RasterOutput,
    vertex_count: int,
    keys: UInt64,
    found: PairList | None,
    gap: float,
    touching: bool = False,
) -> None:
    """Let all silhouette edges write to the pairs of pixels that they separate.

    Args:
        positions: flat clip-space vertices, as rasterized. Detached.
        topology, raster, vertex_count: the mesh and the output of the rasterizer.
        keys: one for each pair (see :mod:`shadowmap_dr.raster.antialiasing.pixel_pairs`), 0 at first; modified. Becomes the
            largest key of the edges between the two pixels. The upper half of a key holds the share of the uncovered pixel that
            the edge's surface hides (a float's bits, and ``BEFORE``), the lower half the complement of the edge's index. So the
            outermost edge wins, and the result does not depend on the order.
        found: list to which pairs are added when the first edge registers.
        gap: least NDC depth between an edge and the surface behind it.
        touching: register also edges that lie on (not before) a surface of another part.
    """
    module = backend(positions)
    count, records, edges = _collect(positions, topology, raster, vertex_count)
    # Lanes that share an edge take turns: edges differ in length, and few are silhouettes.
    lanes, stride = min(_LANES * raster.batch, _MOST_LANES), _LANES_PER_EDGE

    def walk(lane: UInt32) -> tuple[UInt32]:
        slot, turn = lane // stride, lane % stride
        a, b = (dr.gather(module.Array4f, records, 2 * slot + k) for k in range(2))
        index = dr.gather(module.UInt32, edges, slot)
        _walk(a, b, index, turn, stride, topology, raster, keys, found, gap, touching)
        return (lane + uint_input(module, "lanes", lanes),)

    dr.while_loop(
        (dr.arange(module.UInt32, lanes),), lambda *state: state[0] < count * stride, walk, mode="symbolic", label="silhouettes"
    )


def _collect(positions: Float, topology: Topology, raster: RasterOutput, vertex_count: int) -> tuple[UInt32, Float, UInt32]:
    """List the silhouettes that cross lines through pixel centres.

    Returns their number (width 1), records, and indices ``image * E + edge``. A record holds both ends (x and y in pixels from
    the image's centre, NDC depth), the side on which the surface lies (as a sign), and the share of horizontal pairs.
    """
    module = backend(positions)
    width, height = raster.width, raster.height
    total = raster.batch * topology.count
    index = dr.arange(module.UInt32, total)
    image, edge = split(index, "edges", topology.count, raster.batch)
    count, edges, records = dr.zeros(module.UInt32, 1), dr.empty(module.UInt32, total), dr.empty(module.Float, 8 * total)

    def add(index: UInt32, a: Vector3f, b: Vector3f, side: Float, share: Float) -> UInt32:
        slot = scatter_inc(count, module.UInt32(0))
        dr.scatter(edges, index, slot)
        dr.scatter(records, module.ArrayXf(*a, side, *b, share), slot)
        return slot

    def test(index: UInt32, image: UInt32, edge: UInt32) -> UInt32:
        p, q, side, active = _silhouettes(positions, topology, image, edge, vertex_count)
        a, b, active = _project(p, q, active, width, height)
        share = _horizontal_share(b.x - a.x, b.y - a.y, active)
        _, rows = _lines(a.y, b.y, active & (share > 0), "height", height)
        _, columns = _lines(a.x, b.x, active & (share < 1), "width", width)
        active &= rows + columns > 0
        return dr.if_stmt((index, a, b, side, share), active, add, lambda index, *_: index, mode="symbolic", label="silhouette")

    # Most edges of a large scene lie beside a shadow map, or beside what a camera sees.
    ends = dr.gather(module.Array2u, topology.edges, edge)
    first = image * uint_input(module, "vertices", vertex_count)
    near = ~beside([dr.gather(module.Array4f, positions, first + ends[k]) for k in range(2)])
    dr.if_stmt((index, image, edge), near, test, lambda index, *_: index, mode="symbolic", label="edge")
    dr.eval(count, edges, records)
    return count, records, edges


def _walk(
    a: Vector4f,
    b: Vector4f,
    index: UInt32,
    line: UInt32,
    stride: int,
    topology: Topology,
    raster: RasterOutput,
    keys: UInt64,
    found: PairList | None,
    gap: float,
    touching: bool,
) -> None:
    """Visit every ``stride``-th of the lines through pixel centres that edges cross, beginning with ``line``."""
    module = backend(a)
    Float, UInt64 = module.Float, module.UInt64
    width, height = uint_input(module, "width", raster.width), uint_input(module, "height", raster.height)
    left, top = float_input(module, "width", 0.5 - 0.5 * raster.width), float_input(module, "height", 0.5 - 0.5 * raster.height)
    side, share = a.w, b.w
    image, edge = split(index, "edges", topology.count, raster.batch)
    first_row, rows = _lines(a.y, b.y, share > 0, "height", raster.height)
    first_column, columns = _lines(a.x, b.x, share < 1, "width", raster.width)

    def step(line: UInt32, again: Bool) -> tuple[UInt32, Bool]:
        """Process one line through pixel centres: a row (the edge separates pixels of two columns), or a column."""
        across_rows = line < rows
        down = ~across_rows
        at = dr.select(across_rows, first_row + line, first_column + (line - rows))
        fixed = Float(at) + dr.select(across_rows, top, left)
        a_along, a_across = dr.select(down, a.y, a.x), dr.select(down, a.x, a.y)
        b_along, b_across = dr.select(down, b.y, b.x), dr.select(down, b.x, b.y)
        extent = b_across - a_across
        s = (fixed - a_across) / dr.select(extent == 0, 1, extent)
        crossing = dr.fma(s, b_along - a_along, a_along)
        z = dr.fma(s, b.z - a.z, a.z)

        # Pair (i, i + 1) contains the crossing; one on a pixel's centre belongs to (i - 1, i) as well, which comes next.
        size = Float(dr.select(down, height, width))
        middle = 0.5 * size - 0.5
        near = dr.floor(dr.clip(crossing + middle, -2, size + 1))
        near = dr.select(crossing < near - middle, near - 1, near)
        on_center = ~again & (crossing == near - middle)
        near = dr.select(again, near - 1, near)
        t = crossing - (near - middle)
        ok = (extent != 0) & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1) & (near >= 0) & (near + 1 < size)

        row, column = dr.select(down, module.UInt32(near), at), dr.select(down, at, module.UInt32(near))
        pixel = (image * height + row) * width + column
        here = dr.gather(module.UInt32, raster.triangle, pixel, ok)
        neighbour = dr.gather(module.UInt32, raster.triangle, pixel + dr.select(down, width, 1), ok)
        ok &= here != neighbour
        covers_here = dr.select(down, -side, side) * extent > 0
        hidden = dr.select(covers_here, neighbour, here)
        x, y = dr.select(down, fixed, crossing), dr.select(down, crossing, fixed)
        depth = _depth_on_plane(raster, image, hidden, x, y, ok)
        least = dr.fma(dr.abs(depth), _RELATIVE_GAP, gap)
        before = z < depth - least
        on = module.Bool(False)
        if touching:
            on = ok & ~before & (z < depth + least) & (here != NO_TRIANGLE) & (neighbour != NO_TRIANGLE)
            on &= dr.gather(module.UInt32, topology.parts, here, on) != dr.gather(module.UInt32, topology.parts, neighbour, on)
        ok &= before | on

        if topology.see_through_faces is not None:
            # A see-through face hides nothing: its edge counts only if its own surface is visible beside it.
            seen = dr.select(covers_here, here, neighbour)
            hit, counts = ok & (seen != NO_TRIANGLE), module.Bool(False)
            part = dr.gather(module.UInt32, topology.parts, seen, hit)
            for owner in dr.gather(module.Array2u, topology.owners, edge, ok):
                counts |= hit & (part == dr.gather(module.UInt32, topology.parts, owner, hit))
                counts |= ~dr.gather(module.Bool, topology.see_through_faces, owner, ok)
            ok &= counts

        reach = dr.select(covers_here, t, 1 - t)
        key = (UInt64(reinterpret(module.UInt32, reach)) << 32) | UInt64(~edge)
        if touching:
            key |= dr.select(before, UInt64(BEFORE), 0)
        pair = 2 * pixel + dr.select(down, module.UInt32(1), 0)
        # Not "Auto", which would give each thread a copy of a small buffer.
        dr.scatter_reduce(dr.ReduceOp.Max, keys, key, pair, ok, mode=dr.ReduceMode.Direct)
        if found is not None:
            found.add_once(pair, ok)
        return dr.select(on_center, line, line + stride), on_center

    count = rows + columns
    dr.while_loop(
        (line, module.Bool(False)),
        lambda line, *_: line < count,
        step,
        mode="symbolic",
        label="lines that edges cross",
    )


def _silhouettes(
    positions: Float, topology: Topology, image: UInt32, edge: UInt32, vertex_count: int
) -> tuple[Vector4f, Vector4f, Float, Bool]:
    """Clip-space end points of edges, the side of their surface (a sign), and a mask of edges with surface on one side only."""
    module = backend(positions)
    Array4f, Array2u = module.Array4f, module.Array2u
    ends, opposite = dr.gather(Array2u, topology.edges, edge), dr.gather(Array2u, topology.opposite, edge)
    first = image * uint_input(module, "vertices", vertex_count)
    a, b = (dr.gather(Array4f, positions, first + ends[k]) for k in range(2))
    # Orientation is compared, not measured: the cross product is taken around one end point to keep small triangles exact.
    sides = []
    for k in range(2):
        exists = opposite[k] != NO_VERTEX
        o = dr.gather(Array4f, positions, first + opposite[k], exists)
        sides.append(dr.select(exists, _orientation(a, b, o), 0))
    side = dr.select(sides[0] != 0, sides[0], sides[1])
    return a, b, side, (sides[0] * sides[1] >= 0) & (side != 0)


def _orientation(a: Vector4f, b: Vector4f, o: Vector4f) -> Float:
    """Sign of the determinant of three homogeneous (x, y, w) points, in double precision."""
    Float64 = backend(a).Float64
    ax, ay, aw = Float64(a.x), Float64(a.y), Float64(a.w)
    bx, by, bw = Float64(b.x), Float64(b.y), Float64(b.w)
    det = (ay * bw - by * aw) * Float64(o.x) + (bx * aw - ax * bw) * Float64(o.y) + (ax * by - bx * ay) * Float64(o.w)
    return backend(a).Float(dr.select(det == 0, 0, dr.sign(det)))


def _project(a: Vector4f, b: Vector4f, active: Bool, width: int, height: int) -> tuple[Vector3f, Vector3f, Bool]:
    """Clip edges at the near plane and project them to (x, y in pixels from the image's centre, NDC depth).

    Returns both ends, and the mask of edges that are left.
    """
    module = backend(a)
    near_a, near_b = a.z + a.w, b.z + b.w
    # Infinite vertices would be projected to the middle of the image.
    active = active & dr.isfinite(near_a + a.x + a.y + near_b + b.x + b.y) & ((near_a > 0) | (near_b > 0))

    def clip(p: Vector4f, q: Vector4f, near_p: Float, near_q: Float) -> Vector4f:
        # From the end in front, as rasterization does.
        s = near_q / dr.select(near_p < 0, near_q - near_p, 1)
        return dr.select(near_p < 0, dr.fma(p - q, s, q), p)

    a, b = clip(a, b, near_a, near_b), clip(b, a, near_b, near_a)
    active &= (a.w > 0) & (b.w > 0)

    half_width, half_height = float_input(module, "width", 0.5 * width), float_input(module, "height", 0.5 * height)

    def project(p: Vector4f) -> Vector3f:
        inv = dr.rcp(dr.select(active, p.w, 1))
        return module.Array3f(p.x * inv * half_width, p.y * inv * half_height, p.z * inv)

    start, end = project(a), project(b)
    active &= dr.isfinite(start.x + start.y + end.x + end.y)
    return start, end, active


def _horizontal_share(dx: Float, dy: Float, active: Bool) -> Float:
    """Weight of an edge of this direction for horizontal pairs of pixels; 1 minus it is the weight for vertical pairs."""
    dx, dy = dr.select(active, dx, 0), dr.select(active, dy, 0)
    square = dx * dx + dy * dy
    return dr.clip(0.5 + (dy * dy - dx * dx) / dr.select(square > 0, square, 1), 0, 1)


def _lines(p: Float, q: Float, active: Bool, name: str, size: int) -> tuple[UInt32, UInt32]:
    """First of the lines through pixel centres within [p, q] (pixels from the image's centre), and their number."""
    module = backend(p)
    p, q = dr.select(active, p, 0), dr.select(active, q, 0)
    before, after, end = (
        float_input(module, name, value) for value in (0.5 * size - 0.5 - _MARGIN, 0.5 * size - 0.5 + _MARGIN, size)
    )
    low, high = dr.clip(dr.minimum(p, q) + before, -1, end), dr.clip(dr.maximum(p, q) + after, -1, end)
    first = dr.maximum(module.Int32(dr.floor(low)) + 1, 0)
    last = dr.minimum(module.Int32(dr.floor(high)), int_input(module, name, size - 1))
    return module.UInt32(first), module.UInt32(dr.select(active, dr.maximum(last - first + 1, 0), 0))


def _depth_on_plane(raster: RasterOutput, image: UInt32, triangle: UInt32, x: Float, y: Float, active: Bool) -> Float:
    """NDC depth of a triangle's plane at centred pixel coordinates; the far plane where there is no triangle."""
    hit = active & (triangle != NO_TRIANGLE)
    dx, dy, d = raster.depth_plane(image, triangle, hit)
    return dr.fma(dx, x, dr.fma(dy, y, dr.select(hit, d, 1)))

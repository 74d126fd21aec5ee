"""Edges that separate neighbouring pixels, and where they cross the segments between the centres, with derivatives."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import drjit as dr

from ...jit.arrays import backend
from ...jit.kernel_inputs import float_input, uint_input
from ...jit.types import Bool, Float, UInt32, UInt64, Vector4f
from ..topology import NO_VERTEX, Topology
from ..triangle_setup import centred
from ..types import NO_TRIANGLE, RasterOutput, by_pixel, zeros
from .creases import CoplanarCreases, MarkedFaces, find_creases, touching
from .front_surfaces import FrontSurfaces
from .pixel_pairs import PairList, differing_pairs, empty_list
from .silhouettes import BEFORE, register_silhouettes
from .surface_intersections import LEAST_WEIGHT, Meetings, beyond_middle

#: Least distance (NDC depth) of an edge before the surface behind it, for depths of the usual projection matrices.
DEPTH_GAP = 2e-7


@dataclass(frozen=True)
class Crossings:
    """Edges that separate pixels from their right and lower neighbours, for one set of vertex positions. No gradients.

    Attributes:
        right, down: for each pixel, the signed weight of its pair with the right (lower) neighbour. Positive: the pixel reaches
            into its neighbour by this much; negative: the neighbour reaches into the pixel.
        pairs: pairs that may have a weight. The other arrays are indexed by their slots in this list.
        ends: four for each slot: ends of the edge and of a second edge, as vertices of the whole batch; ``NO_VERTEX`` if there
            is no edge.
        slopes, second_slopes: four for each slot: (s, slope x, slope y, slope w). The weight changes by the sum over x, y, w of
            slope * (change of the clip-space edge at the crossing), where the edge's ends count by 1 - s and s. For pairs of
            ``meetings`` the first number is the change of the weight with the depth.
        meetings: intersections of surfaces, which give the weights of pairs without ends; None if these were not searched.
        marked: creases of all faces; None if there are none.
        cuts: for each pixel, not 0 if a translucent surface intersects the raster's between it and its right (lower) neighbour;
            None without translucent surfaces.
    """

    right: Float
    down: Float
    pairs: PairList
    ends: UInt32
    slopes: Float
    second_slopes: Float
    meetings: Meetings | None = None
    marked: MarkedFaces | None = None
    cuts: tuple[Float, Float] | None = None


def find_crossings(
    positions: Float,
    topology: Topology,
    raster: RasterOutput,
    vertex_count: int,
    creases: Bool | None = None,
    crease_weights: Float | None = None,
    meetings: bool = False,
    gap: float = DEPTH_GAP,
    folds: CoplanarCreases | None = None,
    front: FrontSurfaces | None = None,
) -> Crossings:
    """Find the edges between neighbouring pixels.

    Args:
        positions: flat clip-space vertices (4 V B), as rasterized.
        topology: edges of the mesh.
        raster: output of the rasterizer for the same vertices.
        vertex_count: vertices per image, V.
        creases: (3 F,) True if the edge from corner k to k + 1 of a face separates the pixels that see its two faces, as edges of
            flat-shaded faces do, at which colours jump.
        crease_weights: weight of creases at each pixel, between 0 and 1; None for 1.
        meetings: also find the lines along which surfaces that are not connected intersect or touch. Depths do not jump there,
            nor do values that depend on depth alone.
        folds: creases that do not count between coplanar faces. None: all creases count.
        gap: least distance (NDC depth) of a silhouette before the surface behind it, besides 1e-5 of the depth there. Use 0 for
            depths that keep their relative precision, such as -near / distance, and more for depths that approach 1 far away.
        front: with ``meetings``, also find the lines along which these surfaces intersect the raster's. Its records are those of
            all triangles, those in front included.

    A silhouette is an edge whose faces all lie on one side of it in the image. It separates two pixels that see different
    triangles when it crosses the segment between their centres and lies before the surface that the uncovered one sees
    (extended to the crossing). Among several the outermost is taken: up to it the uncovered pixel's surface is hidden.
    With ``meetings`` the edge may also lie on that surface, if this is of another part and the two do not meet in a valley.

    Between two pixels whose triangles touch, the edges through which one leaves the first triangle and enters the other are
    creases. If these are two edges, with invisible faces in between, each edge is weighted by the bend of the surface there.
    Between flat triangles that do not touch, the crease is the line where their planes cross, if it lies between the pixels and
    the faces beside the triangles lie in these planes, too.

    An edge steeper than 60 degrees counts for horizontal pairs only, one flatter than 30 degrees for vertical pairs only, so that
    the two directions together blend each piece of outline once.
    """
    if topology.count == 0:
        raise ValueError("the topology has no edges: all faces of the mesh have two corners at the same place")
    with dr.suspend_grad():
        positions = dr.detach(positions)
        meetings = meetings and topology.part_count > 1
        meet, marked = None, None if creases is None else MarkedFaces.of(dr.detach(creases), folds)
        if marked is None and not meetings:
            pairs, keys = empty_list(raster)
            register_silhouettes(positions, topology, raster, vertex_count, keys, pairs, gap)
        else:
            pairs, keys = differing_pairs(raster, front)
            register_silhouettes(positions, topology, raster, vertex_count, keys, None, gap, meetings)
            crease_weights = None if crease_weights is None else dr.detach(crease_weights)
            dr.eval(crease_weights)
        dr.eval(keys, pairs)
        if marked is not None or meetings:
            meet = Meetings.of(positions, topology, raster, vertex_count, meetings, marked, crease_weights)
        front = front if meetings else None
        return _measure(positions, topology, raster, vertex_count, keys, pairs, marked, crease_weights, meet, front)


def _measure(
    positions: Float,
    topology: Topology,
    raster: RasterOutput,
    vertex_count: int,
    keys: UInt64,
    pairs: PairList,
    marked: MarkedFaces | None,
    crease_weights: Float | None,
    meetings: Meetings | None,
    front: FrontSurfaces | None,
) -> Crossings:
    module = backend(positions)
    Float, Array4f = module.Float, module.Array4f
    pixels = dr.width(raster.triangle)
    right, down, *cuts = zeros(module, pixels, 2 if front is None else 4)
    found = Crossings(
        right,
        down,
        pairs,
        dr.empty(module.UInt32, 8 * pixels),
        dr.empty(Float, 8 * pixels),
        dr.empty(Float, 8 * pixels),
        meetings,
        marked,
        (cuts[0], cuts[1]) if cuts else None,
    )

    def visit(slot: UInt32, pair: UInt32) -> None:
        down, pixel = (pair & 1) != 0, pair >> 1
        step = dr.select(down, uint_input(module, "width", raster.width), 1)
        image, row, column = by_pixel(pixel, raster.batch, raster.height, raster.width)
        key = dr.gather(module.UInt64, keys, pair)
        silhouette = key != 0
        ends = dr.gather(module.Array2u, topology.edges, ~module.UInt32(key & 0xFFFFFFFF), silhouette)
        a, b = (dr.select(silhouette, end, NO_VERTEX) for end in (ends.x, ends.y))
        c, d, weight, weight_2, soft = module.UInt32(NO_VERTEX), module.UInt32(NO_VERTEX), Float(1), Float(0), Float(1)
        seen, edged = None, silhouette
        if front is not None:
            cut, seen = _cut_in_front(topology, raster, front, image, pixel, step, down, ~silhouette | (key < BEFORE))
            edged |= cut | (seen[0] == seen[1])
            for array, active in zip(cuts, (cut & ~down, cut & down), strict=True):
                dr.scatter(array, Float(1), pixel, active)
        if marked is not None:
            if crease_weights is not None:
                soft = dr.minimum(*(dr.gather(Float, crease_weights, p, ~silhouette) for p in (pixel, pixel + step)))

            def crease(image, pixel, step, down, a, b, soft):  # noqa: ANN001, ANN202
                here, neighbour = (dr.gather(module.UInt32, raster.triangle, p) for p in (pixel, pixel + step))
                a, b, c, d, weight, weight_2 = find_creases(marked, topology, raster, image, pixel, here, neighbour, down)
                return a, b, c, d, soft * weight, soft * weight_2

            none = dr.full(module.UInt32, NO_VERTEX, dr.width(pair))
            a, b, c, d, weight, weight_2 = dr.if_stmt(
                (image, pixel, step, down, a, b, soft),
                ~edged & (soft > 0),
                crease,
                lambda *lanes: (lanes[4], lanes[5], none, none, Float(1), Float(0)),
                mode="symbolic",
                label="no silhouette",
            )
        if meetings is not None:
            bare = (a == NO_VERTEX) | (silhouette & (key < BEFORE))
            if seen is None:
                seen = tuple(dr.gather(module.UInt32, raster.triangle, p, bare) for p in (pixel, pixel + step))
            else:
                bare &= seen[0] != seen[1]
            here, there = seen
            cross = functools.partial(_cut, topology, raster, image, pixel, here, there, down)
            meetings.add(slot, dr.select(bare, here, NO_TRIANGLE), there, soft, cross)
        first = image * uint_input(module, "vertices", vertex_count)
        a, b, c, d = (dr.select(end == NO_VERTEX, NO_VERTEX, end + first) for end in (a, b, c, d))
        value, slopes = _weight(positions, a, b, raster, row, column, down, weight)

        def second(slot, c, d, row, column, down, weight_2, value):  # noqa: ANN001, ANN202
            more, slopes = _weight(positions, c, d, raster, row, column, down, weight_2)
            dr.scatter(found.second_slopes, slopes, slot)
            return dr.select((value != 0) & (value + more == 0), value * LEAST_WEIGHT, value + more)

        if marked is not None:
            value = dr.if_stmt(
                (slot, c, d, row, column, down, weight_2, value),
                c != NO_VERTEX,
                second,
                lambda *lanes: lanes[-1],
                mode="symbolic",
                label="second crease",
            )
        dr.scatter(found.ends, module.Array4u(a, b, c, d), slot)
        dr.scatter(found.slopes, Array4f(slopes), slot)
        dr.scatter(found.right, value, pixel, ~down)
        dr.scatter(found.down, value, pixel, down)

    pairs.for_each(visit)
    dr.eval(found)
    if meetings is not None:
        _meet(found, meetings, raster)
        dr.eval(found)
    return found


def _cut(
    topology: Topology, raster: RasterOutput, image: UInt32, pixel: UInt32, here: UInt32, there: UInt32, down: Bool, active: Bool
) -> Bool:
    """True if triangles without a common corner, seen by pixels and their neighbours, may cut each other between these.

    Their planes cross there, and each triangle is seen where it is the nearer one.
    """
    active &= ~touching(topology, here, there)
    planes = (raster.depth_plane(image, triangle, active) for triangle in (here, there))
    a, b, c = (u - v for u, v in zip(*planes, strict=True))
    _, row, column = by_pixel(pixel, raster.batch, raster.height, raster.width)
    x, y = centred(backend(pixel), row, column, raster.height, raster.width)
    start = dr.fma(a, x, dr.fma(b, y, c))
    return active & (start < 0) & (start + dr.select(down, b, a) > 0)


def _cut_in_front(
    topology: Topology,
    raster: RasterOutput,
    front: FrontSurfaces,
    image: UInt32,
    pixel: UInt32,
    step: UInt32,
    down: Bool,
    bare: Bool,
) -> tuple[Bool, tuple[UInt32, UInt32]]:
    """(True if a surface in front may cut the raster's between two pixels, the triangles to look at there).

    ``bare``: True without a silhouette between the pixels.
    """
    here, there = (dr.gather(backend(pixel).UInt32, raster.triangle, p) for p in (pixel, pixel + step))

    def look(image, pixel, step, down, here, there, cut):  # noqa: ANN001, ANN202
        one, other = front.triangles(pixel, pixel + step, here, there, cut)
        cut &= (one != NO_TRIANGLE) & (other != NO_TRIANGLE)
        cut = _cut(topology, raster, image, pixel, one, other, down, cut)
        return cut, dr.select(cut, one, here), dr.select(cut, other, there)

    cut, here, there = dr.if_stmt(
        (image, pixel, step, down, here, there, bare),
        front.differ(pixel, pixel + step, bare),
        look,
        lambda *lanes: (lanes[6] & False, lanes[4], lanes[5]),
        mode="symbolic",
        label="surfaces in front",
    )
    return cut, (here, there)


def _meet(found: Crossings, meetings: Meetings, raster: RasterOutput) -> None:
    """Write the weights of pairs whose triangles intersect. These replace edges that only touch the surface behind them."""
    Array4u = backend(found.ends).Array4u

    def visit(slot: UInt32) -> None:
        pair = found.pairs.at(slot)
        down, pixel = (pair & 1) != 0, pair >> 1
        value, rate = meetings.weights(slot, pixel, down)
        met = value != 0
        dr.scatter(found.ends, Array4u(NO_VERTEX), slot, met)
        dr.scatter(found.slopes, rate, 4 * slot, met)
        dr.scatter(found.right, value, pixel, met & ~down)
        dr.scatter(found.down, value, pixel, met & down)

    meetings.for_each(visit)


def _weight(
    positions: Float, a: UInt32, b: UInt32, raster: RasterOutput, row: UInt32, column: UInt32, down: Bool, weight: Float
) -> tuple[Float, Vector4f]:
    """Signed weight of a pair of pixels between which an edge crosses, 0 where there is none, and its derivatives ("slopes").

    The homogeneous form is valid, in value and derivative, for edges that reach behind the camera.
    """
    module = backend(positions)
    Float, Array4f = module.Float, module.Array4f
    has = a != NO_VERTEX
    p, q = (dr.gather(Array4f, positions, v, has) for v in (a, b))
    width, height = float_input(module, "width", raster.width), float_input(module, "height", raster.height)
    x, y = centred(module, row, column, raster.height, raster.width)
    # The pixel line is y = const (x = const for the lower neighbour) in NDC.
    ndc = dr.select(
        down, x * float_input(module, "width", 2 / raster.width), y * float_input(module, "height", 2 / raster.height)
    )
    p_along, q_along = dr.select(down, p.y, p.x), dr.select(down, q.y, q.x)
    size = dr.select(down, height, width)
    dp = dr.fma(-p.w, ndc, dr.select(down, p.x, p.y))
    dq = dr.fma(-q.w, ndc, dr.select(down, q.x, q.y))
    span = dp - dq
    span = dr.select(has & (span != 0), span, 1)
    s = dp / span
    w = dr.fma(s, q.w - p.w, p.w)
    w = dr.select(has & (w != 0), w, 1)
    value = dr.fma(s, q_along - p_along, p_along) / w
    t = dr.fma(value, 0.5 * size, 0.5 * size - 0.5) - Float(dr.select(down, row, column))
    weight = dr.select(has, weight * _share(p, q, down, raster), 0)

    # d value = sum over both ends of (1 - s, s) / w * (d along - tilt * d across - (value - tilt * ndc) * d w)
    # An edge on a pixel's centre may belong to two pairs (t = 0 and 1): each neighbour covers half of the pixel, and when the
    # edge moves, one half grows as much as the other shrinks.
    slope = dr.select((t >= 0) & (t <= 1), weight * 0.5 * size / w, 0)
    tilt = ((p_along - q_along) - value * (p.w - q.w)) / span
    across = -slope * tilt
    slopes = Array4f(s, dr.select(down, across, slope), dr.select(down, slope, across), -dr.fma(value, slope, ndc * across))
    return weight * beyond_middle(dr.clip(t, 0, 1)), slopes


def _share(p: Vector4f, q: Vector4f, down: Bool, raster: RasterOutput) -> Float:
    """Weight of an edge for horizontal pairs (vertical ones, if ``down``), from the direction of its line in the image."""
    # The line a x + b y + c = 0 in ndc is a (2 / width) x + ... in pixels.
    module = backend(p)
    width, height = float_input(module, "width", raster.width), float_input(module, "height", raster.height)
    nx, ny = (p.y * q.w - q.y * p.w) / width, (q.x * p.w - p.x * q.w) / height
    square = nx * nx + ny * ny
    share = dr.clip(0.5 + (nx * nx - ny * ny) / dr.select(square > 0, square, 1), 0, 1)
    return dr.select(down, 1 - share, share)

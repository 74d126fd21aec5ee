"""Creases between neighbouring pixels: edges at which the surface continues but its colour jumps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import drjit as dr

from ...jit.arrays import backend
from ...jit.types import AnyArray, Bool, Float, UInt32
from ..topology import NO_VERTEX, Topology
from ..triangle_setup import centred
from ..types import NO_TRIANGLE, RasterOutput, by_pixel

#: Ends of a first and of a second edge, and the weights of both.
FoundCreases: TypeAlias = tuple[UInt32, UInt32, UInt32, UInt32, Float, Float]

# Tolerance (relative) for rounding: planes that cross this little beyond two edges count as crossing at the nearer edge.
_SLACK = 0.05
# Sine of the largest angle between coplanar faces, for rounding. It must be small, for bends add up over a surface.
_FLAT = 1e-4


@dataclass(frozen=True)
class CoplanarCreases:
    """Creases that do not count between coplanar faces: within a flat face of many triangles, colours do not jump.

    A change of colour between two pixels there, due to a texture for instance, would count twice if triangles had edges.

    Attributes:
        edges: (3 F,) mask of these creases, from corner k to k + 1 of a face.
        normals: (4 F,) normals of the faces, of any length, and a padding number. Detached.
    """

    edges: Bool
    normals: Float

    def flat(self, here: UInt32, neighbour: UInt32) -> Bool:
        """True if two faces are parallel and face the same side, so that faces with a common point are coplanar."""
        Array3f, Array4f = (getattr(backend(here), name) for name in ("Array3f", "Array4f"))
        n, m = (dr.gather(Array4f, self.normals, face) for face in (here, neighbour))
        n, m = Array3f(n.x, n.y, n.z), Array3f(m.x, m.y, m.z)
        across = dr.squared_norm(dr.cross(n, m))
        return (across <= _FLAT**2 * dr.squared_norm(n) * dr.squared_norm(m)) & (dr.dot(n, m) >= 0)


@dataclass(frozen=True)
class MarkedFaces:
    """Creases of each face in one number, so that a pixel reads those of its triangle at once. Detached.

    Processors gather no bytes: masks are read lane by lane, and each look-up is compiled for each lane.

    Attributes:
        marks: (F,) with bit k for a crease from corner k to k + 1, and bit 3 + k if it is one of the ``folds``.
        folds: creases that do not count between coplanar faces, or None.
    """

    marks: UInt32
    folds: CoplanarCreases | None

    @classmethod
    def of(cls, creases: Bool, folds: CoplanarCreases | None) -> MarkedFaces:
        """From masks of edges, see :func:`find_crossings`."""
        module = backend(creases)
        with dr.suspend_grad():
            face, marks = dr.arange(module.UInt32, dr.width(creases) // 3), module.UInt32(0)
            for shift, edges in ((0, creases), (3, folds and folds.edges)):
                for k in range(3 if edges is not None else 0):
                    marks |= dr.select(dr.gather(module.Bool, edges, 3 * face + k), module.UInt32(1 << (shift + k)), 0)
            dr.eval(marks)
        return cls(marks, folds)

    def at(self, face: UInt32, active: Bool | bool = True) -> UInt32:
        """Marks of faces, 0 where not ``active``."""
        return dr.gather(type(face), self.marks, face, active)

    def crease(self, mark: UInt32, edge: UInt32 | int, soft: Bool) -> Bool:
        """True if an edge (0 to 2) of a face with these marks is a crease; folds do not count where they are ``soft``."""
        bits = mark >> edge
        found = (bits & 1) != 0
        return found if self.folds is None else found & ~(soft & ((bits & 8) != 0))


def find_creases(
    marked: MarkedFaces,
    topology: Topology,
    raster: RasterOutput,
    image: UInt32,
    pixel: UInt32,
    here: UInt32,
    neighbour: UInt32,
    down: Bool,
) -> FoundCreases:
    """Creases between pixels and their right or (where ``down``) lower neighbours.

    Two triangles of one surface have a corner in common, if they are not much smaller than a pixel. The segment to the
    neighbour's centre leaves the first triangle through one edge and enters the second through one, usually the same. If the
    edges differ, other faces of unknown colour lie in between. Each edge is then weighted by the bend of the surface there, which
    is 0 within a flat face of many triangles. The place where the planes of both triangles cross gives the weights: all for the
    first edge, all for the second, or in between. If they do not cross between the edges, each edge counts half.

    Args:
        marked: creases of all faces.
        topology, raster: the mesh and the output of the rasterizer.
        image, pixel: pixels, and their images in the batch.
        here, neighbour: triangles that the pixels and their neighbours see.

    Returns:
        Ends (a, b) of the first edge, ends (c, d) of the second, ``NO_VERTEX`` where there is none, and the weights of both.
    """
    module = backend(here)
    near = touching(topology, here, neighbour)

    def search(image: UInt32, pixel: UInt32, here: UInt32, neighbour: UInt32, down: Bool) -> FoundCreases:
        _, row, column = by_pixel(pixel, raster.batch, raster.height, raster.width)
        x, y = centred(module, row, column, raster.height, raster.width)
        corner_out, way_out, depth, slope = _way_out(raster, image, here, x, y, down, 1)
        x, y = dr.select(down, x, x + 1), dr.select(down, y + 1, y)
        corner_in, way_in, other_depth, other_slope = _way_out(raster, image, neighbour, x, y, down, -1)
        flat = module.Bool(False) if marked.folds is None else marked.folds.flat(here, neighbour)
        hard_out = marked.crease(marked.at(here), corner_out, flat)
        hard_in = marked.crease(marked.at(neighbour), corner_in, flat)
        a, b = _ends(topology, here, corner_out, hard_out)
        c, d = _ends(topology, neighbour, corner_in, hard_in)
        # If both are the same edge, or only the second one is a crease, one edge remains.
        same = hard_out & hard_in & (((a == c) & (b == d)) | ((a == d) & (b == c)))
        a, b = dr.select(hard_out, a, c), dr.select(hard_out, b, d)
        two = hard_out & hard_in & ~same
        # Where the planes cross, from 0 at the first edge to 1 at the second.
        bend = other_slope - slope
        crossing = (depth - (other_depth - other_slope)) / dr.select(bend == 0, 1, bend)
        between = 1 - way_in - way_out
        second = (crossing - way_out) / dr.select(between == 0, 1, between)
        cross = (bend != 0) & (between > 0) & (second >= -_SLACK) & (second <= 1 + _SLACK)
        clipped = dr.clip(second, 0, 1)
        second = dr.select(cross, clipped, 0.5)
        second = dr.select(two, second, 0)
        return a, b, dr.select(two, c, NO_VERTEX), dr.select(two, d, NO_VERTEX), 1 - second, second

    def nothing(image: UInt32, pixel: UInt32, *_: AnyArray) -> FoundCreases:
        none, zero = dr.full(module.UInt32, NO_VERTEX, dr.width(pixel)), dr.zeros(module.Float, dr.width(pixel))
        return none, none, none, none, zero, zero

    arguments = (image, pixel, here, neighbour, down)
    return dr.if_stmt(arguments, near, search, nothing, mode="symbolic", label="creases")


def touching(topology: Topology, first: UInt32, second: UInt32) -> Bool:
    """True if two faces (or none) have a corner in common."""
    module = backend(first)
    active = (first != NO_TRIANGLE) & (second != NO_TRIANGLE)
    mine = dr.gather(module.Array3u, topology.welded, first, active)
    other = dr.gather(module.Array3u, topology.welded, second, active)
    common = module.Bool(False)
    for k in range(3):
        common |= (mine[k] == other.x) | (mine[k] == other.y) | (mine[k] == other.z)
    return active & common


def _way_out(
    raster: RasterOutput, image: UInt32, triangle: UInt32, x: Float, y: Float, down: Bool, sign: int
) -> tuple[UInt32, Float, Float, Float]:
    """The edge through which a ray along an axis of the image leaves a triangle, from a point inside.

    Returns:
        (corner at which the edge starts, distance to it in pixels, depth at the point, change of depth for each pixel in the
        positive direction of the axis, for either ``sign``).
    """
    module = backend(x)
    lines = raster.edge_functions(image, triangle)
    value = dr.fma(lines[0], x, dr.fma(lines[1], y, lines[2]))
    nearest, opposite = module.Float(dr.inf), module.UInt32(0)
    for k in range(3):
        slope = dr.select(down, lines[1][k], lines[0][k]) * -sign
        distance = dr.select(slope > 0, dr.maximum(value[k], 0) / slope, dr.inf)
        opposite = dr.select(distance < nearest, k, opposite)
        nearest = dr.minimum(nearest, distance)
    return _next(opposite), nearest, value.w, dr.select(down, lines[1].w, lines[0].w)


def _next(corner: UInt32) -> UInt32:
    return dr.select(corner == 2, 0, corner + 1)


def _ends(topology: Topology, face: UInt32, corner: UInt32, found: Bool) -> tuple[UInt32, UInt32]:
    """Vertices of the edge that starts at a corner of a face, ``NO_VERTEX`` if not ``found``."""
    UInt32 = backend(face).UInt32
    ends = (dr.gather(UInt32, topology.faces, 3 * face + k, found) for k in (corner, _next(corner)))
    a, b = (dr.select(found, v, NO_VERTEX) for v in ends)
    return a, b

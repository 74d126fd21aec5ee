"""Seams: edges that faces of two shapes share, as one surface, until the shapes move apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import drjit as dr

from ..jit.arrays import backend
from ..jit.types import Point3f, UInt32
from .topology import Topology
from .types import NO_VERTEX

# Vertices of two shapes still coincide within this fraction of their coordinates (rounding), plus this one of the edge's length.
_ROUNDING, _SHORT = 1e-6, 1e-5


def detach_moved_seams(topology: Topology, points: Point3f, shapes: UInt32, hidden: Sequence[int] = ()) -> Topology:
    """The topology of a mesh after its shapes may have moved: seams of shapes that no longer touch become boundaries.

    Args:
        topology: made with the ``shapes`` of its vertices.
        points: (V,) current vertices, in any space. Detached.
        shapes: (V,) shape of each vertex.
        hidden: shapes whose faces are not drawn; their seams are boundaries of the other shapes.
    """
    seams = topology.seams
    if seams is None:
        return topology
    module = backend(topology.edges)
    UInt32, Array2u, Array3f = module.UInt32, module.Array2u, module.Array3f
    index = dr.arange(UInt32, seams.count)
    mine, other, opposite, slots = (dr.gather(Array2u, a, index) for a in (seams.mine, seams.other, seams.opposite, seams.slots))
    points = Array3f(dr.detach(points))
    here, there = ([dr.gather(Array3f, points, v) for v in side] for side in (mine, other))
    least = _SHORT * dr.norm(here[1] - here[0])
    apart = module.Bool(False)
    for p, q in zip(here, there, strict=True):
        apart |= dr.max(dr.abs(p - q)) > dr.fma(_ROUNDING, dr.max(dr.abs(p)), least)
    for shape in hidden:
        apart |= (dr.gather(UInt32, shapes, mine.x) == shape) | (dr.gather(UInt32, shapes, other.x) == shape)
    first = topology.count - 2 * seams.count + index
    edges, opposites, beyond = (UInt32(dr.copy(a)) for a in (topology.edges, topology.opposite, topology.beyond))
    owners = topology.owners
    if owners is not None:
        owners = UInt32(dr.copy(owners))
        one = dr.gather(Array2u, topology.owners, first)
        dr.scatter(owners, dr.select(apart, one.x, one.y), 2 * first + 1)
    dr.scatter(opposites, Array2u(opposite.x, dr.select(apart, NO_VERTEX, opposite.y)), first)
    dr.scatter(edges, dr.select(apart, other, 0), first + seams.count)
    dr.scatter(opposites, Array2u(dr.select(apart, opposite.y, NO_VERTEX), NO_VERTEX), first + seams.count)
    for slot in slots:
        dr.scatter(beyond, UInt32(NO_VERTEX), slot, apart)
    dr.eval(edges, opposites, beyond, owners)
    return replace(topology, edges=edges, opposite=opposites, beyond=beyond, owners=owners)

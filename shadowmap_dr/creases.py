"""Edges of faces at which the colour of a surface jumps, so that they have to be anti-aliased like outlines.

Which these are follows from the faces where they are flat. Between smooth ones it depends on numbers that may change: what a mesh
holds twice, for each side of a line on it, may be equal now and different in the next step of an optimisation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .geometry import Geometry
from .raster import Topology
from .raster._memory import device_array
from .traversal import attributes, is_plain

# Numbers that differ by less (in any component) are the same for the eye.
_NORMAL_JUMP, _ATTRIBUTE_JUMP, _TEXCOORD_JUMP = 0.02, 1e-3, 1e-4


@dataclass(frozen=True)
class Pairs:
    """Edges between smooth faces, K of them, by the half-edges (3 * face + corner) of both faces.

    one, other    UInt32 (K,), half-edges
    ends          ((UInt32 (K,), UInt32 (K,)), likewise): vertices of one and of the other at the edge's first end; at its second
    textured      Bool (K,), whether the material there may read texture coordinates
    """

    one: Any
    other: Any
    ends: tuple[tuple[Any, Any], tuple[Any, Any]]
    textured: Any

    def mark(self, edges: Any, jump: Any) -> None:
        """Set the flags (Bool, 3 F) of the edges for which ``jump`` (Bool, K) holds, on both sides."""
        dr.scatter(edges, mi.Bool(True), self.one, jump)
        dr.scatter(edges, mi.Bool(True), self.other, jump)

    def jump(self, values: Any, size: int, least: float, first: int = 0) -> Any:
        """Bool (K,): whether values of vertices (Float, ``size`` each, from that of ``first`` on) differ by more than that."""
        found = dr.full(mi.Bool, False, dr.width(self.one))
        for one, other in self.ends:
            for k in range(size):
                a, b = (dr.gather(mi.Float, values, (vertex - first) * size + k) for vertex in (one, other))
                found |= dr.abs(a - b) > least
        return found


@dataclass(frozen=True)
class Creases:
    """Where shading jumps. A PyTree that may cross ``dr.freeze``.

    always      Bool (3 F,), edges from corner k to k + 1 of a face at which it does whatever moves: at flat faces, between shapes
    coloured    the same, and where attributes of meshes (colours of vertices, of faces) differ: :meth:`with_attributes`. None if
                there is no edge at all at which shading may ever jump
    seams       edges of smooth shapes whose faces have vertices of their own there, None if there are none
    attributed  (number of the shape, the edges of it at which its attributes may differ)
    """

    always: Any
    coloured: Any
    seams: Pairs | None
    attributed: tuple[tuple[int, Pairs], ...]

    @classmethod
    def of(cls, geometry: Geometry, topology: Topology, sources: Sequence[Any]) -> Creases:
        """Find all edges that may matter (on the host, once)."""
        shapes = geometry.face_shape.numpy()
        smooth = np.array([info.has_normals for info in geometry.shapes])
        one, other, ends = _edges(geometry, topology)
        shape, next_shape = shapes[one // 3], shapes[other // 3]
        within = (shape == next_shape) & smooth[shape]
        always = np.repeat(~smooth[shapes], 3)
        between = (shape != next_shape) & smooth[shape] & smooth[next_shape]
        always[one[between]] = always[other[between]] = True
        own_vertices = (ends[:, :, 0] != ends[:, :, 1]).any(1)
        textured = np.array([info.has_texcoords for info in geometry.shapes])
        textured &= np.array([not is_plain(source.shape.bsdf()) for source in sources])

        def pairs(chosen: np.ndarray) -> Pairs:
            ids = [[device_array(mi.UInt32, ends[chosen, end, side]) for side in range(2)] for end in range(2)]
            edges = [device_array(mi.UInt32, half[chosen]) for half in (one, other)]
            return Pairs(*edges, tuple(map(tuple, ids)), device_array(mi.Bool, textured[shape[chosen]]))

        attributed = []
        for index, (info, source) in enumerate(zip(geometry.shapes, sources, strict=True)):
            if info.reads_attributes and info.has_normals:
                of_faces = any(name.startswith("face_") for name in attributes(source.shape))
                chosen = within & (shape == index) & (own_vertices | of_faces)
                if chosen.any():
                    attributed.append((index, pairs(chosen)))
        seams, fixed = within & own_vertices, device_array(mi.Bool, always)
        found = cls(fixed, fixed, pairs(seams) if seams.any() else None, tuple(attributed))
        if not attributed and not seams.any() and not always.any():
            return replace(found, coloured=None)
        return found.with_attributes(geometry, sources)

    def with_attributes(self, geometry: Geometry, sources: Sequence[Any]) -> Creases:
        """The same for the attributes that meshes have now."""
        if not self.attributed:
            return self
        edges = mi.Bool(self.always)
        with dr.suspend_grad():
            for index, pairs in self.attributed:
                info = geometry.shapes[index]
                for name, values in attributes(sources[index].shape).items():
                    values = dr.detach(mi.Float(values))
                    if name.startswith("vertex_"):
                        size = dr.width(values) // info.vertex_count
                        jump = pairs.jump(values, size, _ATTRIBUTE_JUMP, info.vertex_start)
                    else:
                        size = dr.width(values) // info.face_count
                        faces = (half // 3 - info.face_start for half in (pairs.one, pairs.other))
                        jump = replace(pairs, ends=(tuple(faces),)).jump(values, size, _ATTRIBUTE_JUMP)
                    pairs.mark(edges, jump)
            dr.eval(edges)
        return replace(self, coloured=edges)

    def now(self, geometry: Geometry) -> Any:
        """``Bool`` (3 F,): whether shading jumps at the edge from corner k to k + 1 of a face, with these normals and texture
        coordinates. None if there are no such edges whatever moves. Detached."""
        if self.seams is None:
            return self.coloured
        with dr.suspend_grad():
            edges, seams = mi.Bool(self.coloured), self.seams
            jump = seams.jump(dr.detach(geometry.normals), 3, _NORMAL_JUMP)
            jump |= seams.textured & seams.jump(dr.detach(geometry.texcoords), 2, _TEXCOORD_JUMP)
            seams.mark(edges, jump)
            dr.eval(edges)
        return edges


def _edges(geometry: Geometry, topology: Topology) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges at which two faces meet: half-edges (E,) of one and of the other, vertices (E, ends, sides) at both ends."""
    faces, welded = (np.asarray(a.numpy(), np.int64).reshape(-1, 3) for a in (geometry.faces, topology.welded))
    start, end = welded.ravel(), np.roll(welded, -1, 1).ravel()
    key = np.minimum(start, end) * geometry.vertex_count + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    same = key[order][1:] == key[order][:-1]
    one, other = order[:-1][same], order[1:][same]
    first, second = faces.ravel(), np.roll(faces, -1, 1).ravel()
    # The other's half-edge may run either way.
    reverse = start[one] != start[other]
    ends = np.stack([
        np.stack([first[one], np.where(reverse, second[other], first[other])], 1),
        np.stack([second[one], np.where(reverse, first[other], second[other])], 1),
    ], 1)
    return one, other, ends

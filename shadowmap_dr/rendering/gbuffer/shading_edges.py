"""Edges of faces at which the colour of a surface jumps, so that they have to be anti-aliased like silhouettes.

Edges of flat faces are known from the faces. Between smooth faces they depend on numbers that may change: vertices that a mesh
duplicates along a seam may have equal attributes now and different ones in the next step of an optimisation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from ...jit.arrays import backend, device_array
from ...jit.kernel_inputs import split, uint_input
from ...jit.types import Bool, Float, UInt32
from ...raster import CoplanarCreases, Topology
from ...scene.changes import ParameterWatch
from ...scene.geometry import Geometry
from ...scene.mitsuba_meshes import mesh_names
from ...scene.mitsuba_objects import attributes, is_attribute, is_plain

# Numbers that differ by less (in any component) count as equal. The eye sees no such difference between colours. For normals, it
# allows for rounding only, since small bends add up over a surface.
_NORMAL_JUMP, _COLOUR_JUMP = 1e-4, 1e-3
# Where along an edge the colours of both sides are compared.
_LOOKED_AT = (0.02, 0.5, 0.98)


@dataclass(frozen=True)
class Pairs:
    """Edges between smooth faces, K of them, by the half-edges (3 * face + corner) of both faces.

    one, other    UInt32 (K,), half-edges
    ends          ((UInt32 (K,), UInt32 (K,)), likewise): vertices of one and of the other at the edge's first end; at its second
    """

    one: UInt32
    other: UInt32
    ends: tuple[tuple[UInt32, UInt32], ...]

    def mark(self, edges: Bool, jump: Bool, value: bool = True) -> None:
        """Set the flags (Bool, 3 F) of the edges for which ``jump`` (Bool, K) holds, on both sides."""
        dr.scatter(edges, mi.Bool(value), self.one, jump)
        dr.scatter(edges, mi.Bool(value), self.other, jump)

    def jump(self, values: Float, size: int, least: float, first: int = 0) -> Bool:
        """Mask (Bool, K) of edges whose sides differ by more than ``least``.

        ``values``: of vertices (Float, ``size`` numbers each), beginning with those of vertex ``first``.
        """
        found = dr.full(mi.Bool, False, dr.width(self.one))
        for one, other in self.ends:
            for k in range(size):
                a, b = (dr.gather(mi.Float, values, (vertex - first) * size + k) for vertex in (one, other))
                found |= dr.abs(a - b) > least
        return found


@dataclass(frozen=True)
class ShadingEdges:
    """Edges at which shading jumps. A PyTree that may cross ``dr.freeze``.

    always      Bool (3 F,), edges from corner k to k + 1 of a face at which shading always jumps: at flat faces, between shapes
    bendable    Bool (3 F,), the subset of ``always`` between flat faces of one shape, where shading jumps only if the surface is
                bent; None without such edges
    coloured    ``always``, and edges at which colours of meshes (attributes, textures, emission) differ: :meth:`with_colours`.
                None if shading can jump at no edge
    folds       ``bendable`` without the edges at which colours of meshes differ
    seams       edges of smooth shapes along which vertices are duplicated, None without such edges
    attributed  (number of the shape, its edges at which attributes may differ)
    textured    (number of the shape, its edges at which texture coordinates may differ)
    """

    RECORDED_OFTEN: ClassVar[bool] = True  # see `jit.frozen.take_apart`

    always: Bool
    bendable: Bool | None
    coloured: Bool | None
    folds: Bool | None
    seams: Pairs | None
    attributed: tuple[tuple[int, Pairs], ...]
    textured: tuple[tuple[int, Pairs], ...]

    @classmethod
    def of(cls, geometry: Geometry, topology: Topology, sources: Sequence[Any]) -> ShadingEdges:
        """Find all edges at which shading may ever jump (on the host, once)."""
        shapes = geometry.face_shape.numpy()
        smooth = np.array([info.has_normals for info in geometry.shapes])
        # Face attributes may differ at any edge, vertex attributes only where vertices are duplicated.
        of_faces = np.array([info.reads_attributes for info in geometry.shapes])
        one, other, ends = _edges(geometry, topology, of_faces[shapes])
        shape, next_shape = shapes[one // 3], shapes[other // 3]
        within = shape == next_shape
        always = np.repeat(~smooth[shapes], 3)
        bendable = always.copy()
        always[one[~within]] = always[other[~within]] = True
        bendable[one[~within]] = bendable[other[~within]] = False
        own_vertices = (ends[:, :, 0] != ends[:, :, 1]).any(1)

        def pairs(chosen: np.ndarray) -> Pairs:
            first, second = ([device_array(mi.UInt32, ends[chosen, end, side]) for side in range(2)] for end in range(2))
            half, next_half = (device_array(mi.UInt32, half[chosen]) for half in (one, other))
            return Pairs(half, next_half, ((first[0], first[1]), (second[0], second[1])))

        attributed, textured = [], []
        plain: dict[Any, bool] = {}
        doubled = set(np.unique(shape[within & own_vertices]).tolist())
        for index, (info, source) in enumerate(zip(geometry.shapes, sources, strict=True)):
            if info.reads_attributes:
                has_own = any(name.startswith("face_") for name in attributes(source.shape))
                chosen = within & (shape == index) & (own_vertices | has_own)
                if chosen.any():
                    attributed.append((index, pairs(chosen)))
            if info.has_texcoords and index in doubled and _may_vary(source.shape, plain):
                textured.append((index, pairs(within & (shape == index) & own_vertices)))
        seams, fixed = within & smooth[shape] & own_vertices, device_array(mi.Bool, always)
        flat = device_array(mi.Bool, bendable) if bendable.any() else None
        found = cls(fixed, flat, fixed, flat, pairs(seams) if seams.any() else None, tuple(attributed), tuple(textured))
        if not attributed and not seams.any() and not always.any():
            return replace(found, coloured=None)
        return found.with_colours(geometry, sources)

    def watch(self, sources: Sequence[Any]) -> ParameterWatch:
        """Watch over all inputs of :meth:`with_colours`: attributes, texture coordinates, materials and emission of shapes."""
        nodes = [sources[index].shape for index, _ in self.attributed]
        for index, _ in self.textured:
            shape = sources[index].shape
            nodes += [shape, shape.bsdf(), *([shape.emitter()] if shape.is_emitter() else [])]

        def counts(node: mi.Object, key: str) -> bool:
            if not isinstance(node, mi.Mesh):
                return not isinstance(node, mi.Shape)
            return key == mesh_names(node).texcoords or is_attribute(node, key)

        return ParameterWatch(nodes, counts)

    def with_colours(self, geometry: Geometry, sources: Sequence[Any]) -> ShadingEdges:
        """The same edges, updated for the current attributes, texture coordinates and textures of meshes.

        Colours are compared, not texture coordinates: most seams of a texture have the same colour on both sides.
        """
        if not self.attributed and not self.textured:
            return self
        edges, folds = mi.Bool(self.always), self.bendable
        jumps = []
        with dr.suspend_grad():
            for index, pairs in self.attributed:
                info = geometry.shapes[index]
                for name, values in attributes(sources[index].shape).items():
                    values = dr.detach(mi.Float(values))
                    if name.startswith("vertex_"):
                        size = dr.width(values) // info.vertex_count
                        jump = pairs.jump(values, size, _COLOUR_JUMP, info.vertex_start)
                    else:
                        size = dr.width(values) // info.face_count
                        faces = pairs.one // 3 - info.face_start, pairs.other // 3 - info.face_start
                        jump = replace(pairs, ends=(faces,)).jump(values, size, _COLOUR_JUMP)
                    jumps.append((pairs, jump))
            for index, pairs in self.textured:
                texcoords = mi.Float(sources[index].own().texcoords)
                first = geometry.shapes[index].vertex_start
                jumps.append((pairs, _other_colours(sources[index].shape, texcoords, pairs, first)))
            for pairs, jump in jumps:
                pairs.mark(edges, jump)
            if folds is not None:
                folds = mi.Bool(folds)
                for pairs, jump in jumps:
                    pairs.mark(folds, jump, False)
            dr.eval(edges, folds)
        return replace(self, coloured=edges, folds=folds)

    def now(self, geometry: Geometry) -> Bool | None:
        """Mask (Bool, 3 F) of the edges from corner k to k + 1 of a face at which shading jumps, given the geometry's normals.

        None if shading can jump at no edge. Detached.
        """
        if self.seams is None:
            return self.coloured
        with dr.suspend_grad():
            edges, seams = mi.Bool(self.coloured), self.seams
            seams.mark(edges, seams.jump(dr.detach(geometry.normals), 3, _NORMAL_JUMP))
            dr.eval(edges)
        return edges

    def folds_of(self, normals: Float | None) -> CoplanarCreases | None:
        """Edges at which shading jumps only if the surface is bent there. ``normals``: of flat faces (Float, 4 F), if any."""
        return None if self.folds is None or normals is None else CoplanarCreases(self.folds, normals)


def _may_vary(shape: mi.Shape, plain: dict[Any, bool]) -> bool:
    """True if a shape's colour may depend on texture coordinates. ``plain``: cache of :func:`is_plain`, filled here."""
    bsdf = shape.bsdf()
    if bsdf not in plain:
        plain[bsdf] = is_plain(bsdf)
    return not plain[bsdf] or shape.is_emitter()


def _other_colours(shape: mi.Shape, texcoords: Float, pairs: Pairs, first: int) -> Bool:
    """Mask (Bool, K) of edges with different colours on both sides, seen and lit along the normal. Detached.

    ``texcoords``: of the shape's vertices (Float, 2 each), of which the first is vertex ``first`` of the scene.
    """
    # Numbers that differ from shape to shape are inputs of kernels.
    module, count, places = backend(texcoords), dr.width(pairs.one), 2 * len(_LOOKED_AT)
    before, edges = uint_input(module, "vertices before", first), uint_input(module, "edges of a shape", count)
    place, pair = split(dr.arange(mi.UInt32, places * count), "edges of a shape", count, places)
    along = mi.Float(_LOOKED_AT[0])
    for k, value in enumerate(_LOOKED_AT):
        along = dr.select(place >> 1 == k, value, along)
    ends = []
    for sides in pairs.ends:
        here, there = (dr.gather(mi.UInt32, vertices, pair) for vertices in sides)
        ends.append(dr.gather(mi.Point2f, dr.detach(texcoords), dr.select(place & 1 == 0, here, there) - before))
    si = dr.zeros(mi.SurfaceInteraction3f, places * count)
    si.uv = dr.lerp(ends[0], ends[1], along)
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    si.sh_frame, si.n, si.wi = mi.Frame3f(mi.Vector3f(0, 0, 1)), mi.Normal3f(0, 0, 1), mi.Vector3f(0, 0, 1)
    colours = [shape.bsdf().eval(mi.BSDFContext(), si, si.wi)]
    if shape.is_emitter():
        colours.append(shape.emitter().eval(si))
    lane, found = dr.arange(mi.UInt32, count), dr.full(mi.Bool, False, count)
    channels = [channel + dr.zeros(mi.Float, dr.width(si.uv)) for colour in colours for channel in mi.UnpolarizedSpectrum(colour)]
    dr.eval(channels)
    for channel in channels:
        for k in range(len(_LOOKED_AT)):
            one, other = (dr.gather(mi.Float, channel, lane + (2 * k + side) * edges) for side in range(2))
            found |= dr.abs(one - other) > _COLOUR_JUMP * (1 + dr.abs(one))
    return found


def _edges(geometry: Geometry, topology: Topology, everywhere: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges at which two faces meet: half-edges (E,) of one and of the other, vertices (E, ends, sides) at both ends.

    ``everywhere`` (F,) selects faces of which all edges are returned; of others, only edges with an end at duplicated vertices.
    """
    faces, welded = (a.numpy() for a in (geometry.faces, topology.welded))
    several = np.zeros(geometry.vertex_count, bool)
    several[welded[faces != welded]] = True
    at_corners = several[welded].reshape(-1, 3)
    rows = np.flatnonzero(at_corners[:, 0] | at_corners[:, 1] | at_corners[:, 2] | everywhere)
    chosen = at_corners[rows] | at_corners[rows][:, [1, 2, 0]] | everywhere[rows, None]
    half = (3 * rows[:, None] + np.arange(3))[chosen]
    after = half + np.where(half % 3 == 2, -2, 1)
    start, end = welded[half].astype(np.int64), welded[after].astype(np.int64)
    key = np.minimum(start, end) * geometry.vertex_count + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    same = key[order][1:] == key[order][:-1]
    one, other = order[:-1][same], order[1:][same]
    first, second = faces[half].astype(np.int64), faces[after].astype(np.int64)
    # The half-edge of the other face may run in either direction.
    reverse = start[one] != start[other]
    ends = np.stack(
        [
            np.stack([first[one], np.where(reverse, second[other], first[other])], 1),
            np.stack([second[one], np.where(reverse, first[other], second[other])], 1),
        ],
        1,
    )
    return half[one], half[other], ends

"""Flat-shaded surfaces whose facets are smaller than a pixel.

The colour of a flat-shaded mesh jumps from facet to facet. Anti-aliasing of the edges between facets handles facets larger than
pixels. Smaller facets cannot be sampled: a pixel's centre sees one of many facets at random, and the derivative of its colour is
unrelated to the derivative of the pixel's average. Up to the size of a facet, that average is the shading of the facets' mean
normal, so the mean normal is shaded.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from ...jit.arrays import device_array, ravel
from ...jit.branches import branch
from ...jit.types import Bool, Float, Normal3f, UInt32, Vector3f, Vector4f
from ...jit.vectors import normalize_or
from ...raster import Topology
from ...scene.geometry import HAS_NORMALS, Geometry
from .surface_points import SurfacePoints

# Facets below the first size (in pixels) are shaded with mean normals, those above the second with their own.
_SMALL, _LARGE = 1.5, 3.0


@dataclass(frozen=True)
class FlatFaces:
    """Flat faces that meet at each place of a mesh: place v has the faces ``faces[start[v]:start[v + 1]]``, ``UInt32`` each.

    ``flat``: ``Bool`` (F,), True for flat faces.
    """

    RECORDED_OFTEN: ClassVar[bool] = True  # see `jit.frozen.take_apart`

    start: UInt32
    faces: UInt32
    flat: Bool


def flat_faces(geometry: Geometry, topology: Topology) -> FlatFaces | None:
    """Faces of shapes without vertex normals, by welded vertex; None if all shapes have some (on the host, once)."""
    flat = np.array([not info.has_normals for info in geometry.shapes])
    if not flat.any():
        return None
    chosen = flat[geometry.face_shape.numpy()]
    faces = np.flatnonzero(chosen).astype(np.uint32)
    places = topology.welded.numpy().reshape(-1, 3)[faces].ravel()
    order = np.argsort(places, kind="stable")
    start = np.searchsorted(places[order], np.arange(geometry.vertex_count + 1))
    return FlatFaces(device_array(mi.UInt32, start), device_array(mi.UInt32, faces[order // 3]), device_array(mi.Bool, chosen))


def facet_normals(geometry: Geometry, flat: FlatFaces) -> Float:
    """Normals of the flat faces, as long as (twice) the faces are large, 0 for others (Float, 4 F). Attached.

    Four numbers and not three (the last is 0), since packets of four are read faster.
    """
    face = dr.arange(mi.UInt32, geometry.face_count)
    _, e1, e2 = geometry.triangle(dr.gather(mi.Vector3u, geometry.faces, face, flat.flat), flat.flat)
    n = dr.cross(e1, e2)
    normals = ravel(mi.Vector4f(n.x, n.y, n.z, 0))
    dr.eval(normals)
    return normals


def mean_normals(normals: Float, topology: Topology, flat: FlatFaces) -> Float:
    """Sums of the flat faces' normals (:func:`facet_normals`) at each place (Float, 4 V, by welded vertex). Attached."""
    return dr.custom(_Sums, normals, topology, flat)


class _Sums(dr.CustomOp):
    """Sums over the faces at each place. Both passes gather their terms: atomic additions would cost several times as much."""

    def eval(self, normals: Float, topology: Topology, flat: FlatFaces) -> Float:
        self.topology, self.flat, self.faces = topology, flat, dr.width(normals) // 4
        return self._at_places(normals)

    def forward(self) -> None:
        self.set_grad_out(self._at_places(mi.Float(self.grad_in("normals"))))

    def backward(self) -> None:
        adjoint = self.grad_out()
        dr.eval(adjoint)
        places = dr.gather(mi.Vector3u, self.topology.welded, dr.arange(mi.UInt32, self.faces), self.flat.flat)
        total = mi.Vector4f(0)
        for k in range(3):
            total += dr.gather(mi.Vector4f, adjoint, places[k], self.flat.flat)
        self.set_grad_in("normals", dr.ravel(total))

    def _at_places(self, normals: Float) -> Float:
        dr.eval(normals)
        place = dr.arange(mi.UInt32, dr.width(self.flat.start) - 1)
        at, end = dr.gather(mi.UInt32, self.flat.start, place), dr.gather(mi.UInt32, self.flat.start, place + 1)

        def more(at: UInt32, end: UInt32, total: Vector4f) -> Bool:
            return at < end

        def add(at: UInt32, end: UInt32, total: Vector4f) -> tuple[UInt32, UInt32, Vector4f]:
            face = dr.gather(mi.UInt32, self.flat.faces, at)
            return at + 1, end, total + dr.gather(mi.Vector4f, normals, face)

        state = (at, end, dr.zeros(mi.Vector4f, dr.width(place)))
        total = dr.while_loop(state, more, add, mode="symbolic", label="faces at a place")[2]
        result = ravel(total)
        dr.eval(result)
        return result


def prefilter_normals(
    hits: SurfacePoints, normals: tuple[Normal3f, Normal3f], topology: Topology, mean: Float
) -> tuple[tuple[Normal3f, Normal3f], Float]:
    """Replace the normals of flat-shaded facets smaller than pixels by the mean over their neighbourhood.

    ``normals`` (geometric, shading) and the result are as :func:`shadowmap_dr.rendering.gbuffer.surface.normals_at`, ``mean`` is
    the sum that :func:`mean_normals` returns. Also returns the share of a facet's own normal in the result (Float, 0 to 1), by
    which edges between facets remain visible. Gradients flow to the vertices through the new normals, not through facet sizes.
    """
    with dr.suspend_grad():
        # A facet's size is the square root of (twice) its area. Fourth powers are compared, to avoid the roots.
        square = dr.squared_norm(dr.cross(dr.detach(hits.e1), dr.detach(hits.e2)))
        pixel = mi.Float(hits.pixel)
        soft = hits.active & ((hits.flags & HAS_NORMALS) == 0) & (square < dr.square(dr.square(_LARGE * pixel)))

    def mixed(
        triangle: UInt32, u: Float, v: Float, n_world: Vector3f, n_shading: Vector3f, square: Float, pixel: Float
    ) -> tuple[Normal3f, Normal3f, Float]:
        size = dr.sqrt(dr.sqrt(square))
        mix = dr.detach(dr.clip((_LARGE - size / pixel) / (_LARGE - _SMALL), 0, 1))
        slot = dr.gather(mi.Vector3u, topology.welded, triangle)
        sums = [dr.gather(mi.Vector4f, mean, slot[k]) for k in range(3)]
        n = [normalize_or(mi.Normal3f(s.x, s.y, s.z), mi.Normal3f(0)) for s in sums]
        normal = n[0] + (n[1] - n[0]) * u + (n[2] - n[0]) * v
        normal = dr.select(dr.dot(normal, n_world) < 0, -normal, normal)
        normal = mi.Normal3f(normalize_or(n_shading + (normal - n_shading) * mix, n_shading))
        return normal, normal, 1 - mix

    def own_normals(
        triangle: UInt32, u: Float, v: Float, n_world: Vector3f, n_shading: Vector3f, square: Float, pixel: Float
    ) -> tuple[Normal3f, Normal3f, Float]:
        return n_world, n_shading, mi.Float(1)

    # Most pixels of a large image see large facets: the branch skips their look-ups.
    arguments = (hits.triangle, hits.u, hits.v, *normals, square, pixel)
    n_world, n_shading, own = branch(soft, mixed, own_normals, arguments, "soften facets")
    return (n_world, n_shading), dr.detach(own)

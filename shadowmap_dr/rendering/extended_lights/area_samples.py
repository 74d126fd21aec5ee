"""Area lights: sample points on the emitting surface, each for a part of the surface."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...jit.arrays import device_array
from ...jit.types import ArrayT, Color3f, Float, Point2f, UInt32, Vector3f
from ...scene.geometry import Geometry, ShapeInfo
from ...scene.lights.area import AreaLight
from .clusters import facet_clusters, surface_clusters, unevenness
from .samples import Facets, LightSamples, brightness, cluster_sums

# Pieces of the emitter for each sample, at least; and how many more of them a texture needs, up to so many in all.
_PIECES = 64
_TEXTURED, _MOST = 16, 1 << 17
# Disks that stand for a sample's part of an emitter that is not flat; and if there are few samples, or normals differ within a
# disk by more than this from those of an evenly bent sheet, as an animal's do.
_FACETS, _MORE_FACETS, _UNEVEN = 4, 8, 0.15
_FEW_SAMPLES = 16
# Weight of what is dark in the middle of a facet, in units of the emitter's mean brightness.
_DIM = 1e-3
# Importance of what faces away from everything, in units of the mean.
_AWAY = 0.1
# A part of an emitter that faces opposite ways is as bad as one that is twice as long, in units of the distance to what is near.
_OPPOSITE = 0.35
# How far a part of an emitter must lie before the plane of another to be seen from it, in units of the emitter's extent.
_DENT = 1e-3
# Radius of an emitter over the distance of what is nearest, up to which it is far away.
_FAR = 0.06
# Points on the rest of the scene that are asked whether they see a piece.
_PROBES = 256


@dataclass(frozen=True)
class AreaPlan:
    """The pieces of an emitter and their clusters. Static; made once for a scene.

    face      UInt32 (P,), triangle of the soup that a piece lies in
    u, v      Float (P,), barycentrics of its centre
    fraction  Float (P,), share of the triangle's area; negative where the emitter shines on the back of the triangle
    cluster   UInt32 (P,), cluster of the piece, one of N
    chosen    UInt32 (N,), piece whose centre is the sample of a cluster
    shape     index of the emitter's shape
    facet     UInt32 (P,), facet of the piece; each cluster has ``facets`` of them
    facets    number of disks that represent the part of a sample
    far       True if the emitter is small, seen from the nearest points of the scene
    dented    True if parts of the emitter face the shining side of other parts. False if the emitter shines on the backs of its
              triangles, since maps then show the fronts only
    """

    face: UInt32
    u: Float
    v: Float
    fraction: Float
    cluster: UInt32
    chosen: UInt32
    shape: int
    dented: bool
    facet: UInt32
    facets: int
    far: bool


def plan_area(light: AreaLight, geometry: Geometry, count: int) -> AreaPlan:
    """Divide an emitter into ``count`` parts (on the host, once).

    Parts that face the rest of the scene, or are brighter, are smaller. Parts that no other surface sees get few samples.
    """
    info = geometry.shapes[light.shape]
    positions = dr.detach(geometry.positions).numpy().reshape(-1, 3).astype(np.float64)
    faces = geometry.faces.numpy().reshape(-1, 3)
    own = slice(info.face_start, info.face_start + info.face_count)
    corners = positions[faces[own]]
    normals, areas = _normals(corners)
    sign = _shining_side(geometry, info, normals, faces[own])
    normals *= sign[:, None]
    pieces = _PIECES * count
    face, (u, v), fraction = _pieces(areas, max(pieces, min(_TEXTURED * pieces, _MOST)) if light.textured else pieces)
    a, b, c = (corners[face, k] for k in range(3))
    centres = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    probes = _probes(geometry, positions, faces, own)
    importance, nearest = _importance(centres, normals[face], probes)
    with dr.suspend_grad():
        shine = _brightness(light, geometry, face + info.face_start, u, v)
    weights = fraction * areas[face] * importance * (shine + _AWAY * max(shine.mean(), 1e-30))
    weights = np.maximum(weights, 1e-12 * max(weights.max(), 1e-300))
    cluster, chosen = surface_clusters(centres, weights, count, normals[face], _OPPOSITE * nearest)
    bright = fraction * areas[face] * (shine + _DIM * shine.mean())
    facet, facets = _divided(info.planar, (centres, normals[face], bright, cluster), nearest)
    return AreaPlan(
        face=device_array(mi.UInt32, face + info.face_start),
        u=device_array(mi.Float, u),
        v=device_array(mi.Float, v),
        fraction=device_array(mi.Float, fraction * sign[face]),
        cluster=device_array(mi.UInt32, cluster),
        chosen=device_array(mi.UInt32, chosen),
        shape=light.shape,
        dented=not info.planar and bool((sign > 0).all()) and _dented(centres[chosen], corners, normals),
        facet=device_array(mi.UInt32, facet),
        facets=facets,
        far=_seen_from_afar(centres, nearest),
    )


def _seen_from_afar(centres: np.ndarray, nearest: np.ndarray) -> bool:
    """True if pieces (P, 3) lie close together, compared to their distances (P,) from what is nearest."""
    radius = np.linalg.norm(centres - 0.5 * (centres.min(0) + centres.max(0)), axis=1).max()
    return bool(radius < _FAR * nearest.min())


def _divided(planar: bool, pieces: tuple[np.ndarray, ...], nearest: np.ndarray) -> tuple[np.ndarray, int]:
    """(facet of each piece, facets of each cluster). ``pieces``: their positions, normals, weights and clusters."""
    positions, normals, weights, cluster = pieces
    if planar:
        return facet_clusters(positions, normals, weights, cluster, 1, nearest), 1
    if cluster.max() + 1 >= _FEW_SAMPLES:
        facet = facet_clusters(positions, normals, weights, cluster, _FACETS, nearest)
        if unevenness(positions, normals, weights, facet) <= _UNEVEN:
            return facet, _FACETS
    return facet_clusters(positions, normals, weights, cluster, _MORE_FACETS, nearest), _MORE_FACETS


def area_samples(light: AreaLight, plan: AreaPlan, geometry: Geometry) -> LightSamples:
    """Current samples of an emitter. Attached to its vertices and its radiance."""
    info, count = geometry.shapes[plan.shape], dr.width(plan.chosen)
    if geometry.changed is not None and info.name not in geometry.changed:
        # No gradients flow to its vertices, although they do to those of other shapes in the same arrays.
        geometry = replace(geometry, positions=dr.detach(geometry.positions), packets=None)
    corners = geometry.triangle(dr.gather(mi.Vector3u, geometry.faces, plan.face))
    first, e1, e2 = (mi.Vector3f(corner) for corner in corners)
    vector = dr.cross(e1, e2) * (0.5 * plan.fraction)
    area = dr.norm(vector)
    radiance = light.radiance(_uv(geometry, plan.face, plan.u, plan.v, info))
    position = mi.Vector3f(first + e1 * plan.u + e2 * plan.v)
    place = _at(position, plan.chosen)
    total = cluster_sums(area, plan.cluster, count)
    return LightSamples(
        distant=False,
        place=place,
        normal=cluster_sums(vector, plan.cluster, count) * dr.rcp(dr.maximum(total, 1e-30)),
        power=cluster_sums(radiance * area, plan.cluster, count),
        area=total,
        facets=_facets(light, plan, info.planar, (position, vector, area, radiance), dr.detach(place)),
    )


def _facets(
    light: AreaLight, plan: AreaPlan, planar: bool, pieces: tuple[Vector3f, Vector3f, Float, Color3f], place: Vector3f
) -> Facets:
    """The disks that shine like an emitter. ``pieces``: their positions, area vectors, areas and radiances."""
    position, vector, area, radiance = pieces
    # Relative to the samples, which keeps digits.
    offset = position - _at(place, plan.cluster)
    count = dr.width(place) * plan.facets
    # Where a facet shines, and which way, is the mean over its light.
    weight = area * _relative(radiance) if light.textured else area
    sums = cluster_sums(weight, plan.facet, count)
    share = dr.rcp(dr.maximum(sums, 1e-30))

    def mean(values: ArrayT) -> ArrayT:
        whole: Any = values  # Any: a number or a vector
        return cluster_sums(whole * weight, plan.facet, count) * share

    n = vector * dr.rcp(dr.maximum(area, 1e-30))
    normal, middle, bend = mean(n), mean(offset), dr.zeros(mi.Float, count)
    if not planar:
        # What bends shines like a flat disk with the same outline, as far below its middle as the middle is below its top.
        sag = mean(dr.dot(offset, n)) - dr.dot(middle, normal)
        squared = dr.squared_norm(normal)
        middle -= normal * (0.5 * sag * dr.rcp(dr.maximum(squared, 0.1)))
        bend = dr.mulsign(dr.sqrt(dr.maximum(1 - squared, 1e-8)), dr.detach(sag))
    part = dr.arange(mi.UInt32, count) // plan.facets
    in_all = dr.gather(mi.Float, cluster_sums(weight, plan.cluster, dr.width(place)), part)
    shown = cluster_sums(area, plan.facet, count) * _length(normal)
    return Facets(
        count=plan.facets,
        flat=planar,
        far=plan.far,
        middle=_at(place, part) + middle,
        normal=normal * (sums * dr.rcp(dr.maximum(in_all, 1e-30))),
        radius=dr.sqrt(dr.maximum(shown * (1 / math.pi), 1e-30)),
        bend=bend,
    )


def _at(values: Vector3f, index: UInt32) -> Vector3f:
    """Vectors (Vector3f) with these indices."""
    return mi.Vector3f(*(dr.gather(mi.Float, values[c], index) for c in range(3)))


def _length(vector: Vector3f) -> Float:
    return dr.sqrt(dr.maximum(dr.squared_norm(vector), 1e-20))


def _relative(radiance: Color3f) -> Float:
    """Brightness of pieces (Float, P) relative to their mean, plus a small number, so that dark parts have a centre, too."""
    bright = dr.maximum(dr.mean(mi.UnpolarizedSpectrum(radiance)), 0)
    return bright * dr.rcp(dr.maximum(dr.detach(dr.mean(bright)), 1e-30)) + _DIM


def _uv(geometry: Geometry, face: UInt32, u: Float, v: Float, info: ShapeInfo) -> Point2f:
    """Texture coordinates (Point2f), as Mitsuba has them: barycentrics on shapes without any."""
    if not info.has_texcoords:
        return mi.Point2f(u, v)
    corner = dr.gather(mi.Vector3u, geometry.faces, face)
    a, b, c = (dr.gather(mi.Point2f, geometry.texcoords, corner[k]) for k in range(3))
    return a * (1 - u - v) + b * u + c * v


def _brightness(light: AreaLight, geometry: Geometry, face: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    arguments = (device_array(mi.UInt32, face), device_array(mi.Float, u), device_array(mi.Float, v))
    radiance = light.radiance(_uv(geometry, *arguments, geometry.shapes[light.shape]))
    return brightness(light.name, radiance, len(face))


def _normals(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(unit normals (F, 3), areas (F,)) of triangles (F, 3, 3)."""
    n = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(n, axis=1)
    n /= np.maximum(length, 1e-300)[:, None]
    return n, 0.5 * length


def _shining_side(geometry: Geometry, info: ShapeInfo, normals: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """1 or -1 (F,): whether triangles with these normals (F, 3) shine on that side of them.

    Mitsuba's lights shine where vertex normals point, which meshes with a mirroring ``to_world`` have on the other side.
    """
    side = np.full(len(faces), -1.0 if info.flip_geometric else 1.0)
    if info.has_normals:
        smooth = dr.detach(geometry.normals).numpy().reshape(-1, 3)[faces].sum(1)
        cosine = (smooth * normals).sum(1) * (-1 if info.flip_shading else 1)
        side = np.where(cosine == 0, side, np.sign(cosine))
    return side


def _pieces(areas: np.ndarray, count: int) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Cut triangles into equal parts, larger ones into more, ``count`` or more in all.

    Returns (triangle, (barycentrics of vertices 1 and 2 of the centre), share of the triangle), one entry a piece.
    """
    # An emitter without area may get some later.
    share = areas / areas.sum() if areas.sum() > 0 else np.full(len(areas), 1 / len(areas))
    sides = np.maximum(np.ceil(np.sqrt(share * count)), 1).astype(np.int64)
    face, u, v = [], [], []
    for n in np.unique(sides):
        own = np.flatnonzero(sides == n)
        i, j = np.divmod(np.arange(n * n), n)
        # Cells of an n x n lattice over the unit square; those beyond the diagonal are the other halves of cells before it.
        upper = i + j >= n
        cu = np.where(upper, (n - 1 - i) + 2 / 3, i + 1 / 3) / n
        cv = np.where(upper, (n - 1 - j) + 2 / 3, j + 1 / 3) / n
        face.append(np.repeat(own, n * n))
        u.append(np.tile(cu, len(own)))
        v.append(np.tile(cv, len(own)))
    face_all = np.concatenate(face)
    return face_all, (np.concatenate(u), np.concatenate(v)), 1.0 / sides[face_all] ** 2


def _probes(geometry: Geometry, positions: np.ndarray, faces: np.ndarray, own: slice) -> np.ndarray:
    """Points (K, 3) on the other shapes: half of them spread by area, half by number of triangles."""
    others = np.concatenate([faces[: own.start], faces[own.stop :]])
    if not len(others):
        return np.zeros((0, 3))
    corners = positions[others]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    random = np.random.default_rng(0)
    half = _PROBES // 2
    by_area = np.searchsorted(areas.cumsum(), (np.arange(half) + 0.5) / half * areas.sum())
    by_count = np.linspace(0, len(others) - 1, half).astype(np.int64)
    chosen = corners[np.minimum(np.concatenate([by_area, by_count]), len(others) - 1)]
    weights = random.dirichlet((1.0, 1.0, 1.0), len(chosen))
    return (chosen * weights[:, :, None]).sum(1)


def _dented(places: np.ndarray, corners: np.ndarray, normals: np.ndarray) -> bool:
    """True if some of the places (N, 3) on a surface lie before the planes of its triangles (F, 3, 3)."""
    offsets = (corners[:, 0] * normals).sum(1)
    highest = max(float((normals @ place - offsets).max()) for place in places)
    return highest > _DENT * np.ptp(corners.reshape(-1, 3), axis=0).max()


def _importance(centres: np.ndarray, normals: np.ndarray, probes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(how much of the scene each piece (P) sees, at its mean 1; its distance from the nearest probe, 0 if there is none).

    The former is the mean cosine towards the probes, and a little more.
    """
    if not len(probes):
        return np.ones(len(centres)), np.zeros(len(centres))
    # Around a point between them, where products of coordinates lose least.
    middle = probes.mean(0)
    centres, probes = centres - middle, probes - middle
    seen, nearest = np.zeros(len(centres)), np.zeros(len(centres))
    # Blocks that stay in a core's cache.
    for block in np.array_split(np.arange(len(centres)), max(1, len(centres) // 128)):
        own, n = centres[block], normals[block]
        squared = (own**2).sum(1)[:, None] + (probes**2).sum(1) - 2 * own @ probes.T
        distance = np.sqrt(np.maximum(squared, 1e-24))
        seen[block] = (np.maximum(n @ probes.T - (n * own).sum(1)[:, None], 0) / distance).mean(1)
        nearest[block] = distance.min(1)
    mean = seen.mean()
    return seen / mean + _AWAY if mean > 0 else np.ones(len(centres)), nearest

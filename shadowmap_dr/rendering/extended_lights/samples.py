"""Samples of extended lights: a fixed number of points, or of directions, each with its own shadow map."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...errors import ShadowmapError
from ...jit.arrays import ravel
from ...jit.types import ArrayT, Bool, Color3f, Float, Point3f, UInt32, Vector3f, Vector4f
from ...jit.vectors import direction_and_length


@dataclass(frozen=True)
class Facets:
    """Disks that shine like the N parts of an emitter: ``count`` for each part, one after the other, F in all.

    count   static
    flat    True if all parts are flat (static)
    far     True if the emitter is small, seen from all that is near it (static)
    middle  Vector3f (F,), centres, world space
    normal  Vector3f (F,), mean normals of the represented surface, times its share of the part
    radius  Float (F,)
    bend    Float (F,), standard deviation of normals, negative for concave surfaces

    All may carry gradients.
    """

    count: int
    flat: bool
    far: bool
    middle: Vector3f
    normal: Vector3f
    radius: Float
    bend: Float

    def packets(self) -> list[Vector4f]:
        """The fields as two rows of four numbers."""
        m, n = self.middle, self.normal
        return [mi.Vector4f(m.x, m.y, m.z, self.radius), mi.Vector4f(n.x, n.y, n.z, self.bend)]


@dataclass(frozen=True)
class LightSamples:
    """N points of a near light (an area light), or N directions of a light at infinity.

    distant  True for directions (static)
    place    Vector3f (N,), positions, or unit directions in which light travels, world space
    normal   Vector3f (N,), mean normals of the parts, shorter than 1 for curved parts (unused if distant)
    power    colour (N,), radiance times area, or irradiance on a surface that faces the light
    area     Float (N,), share of the emitter's area (unused if distant)
    facets   disks that shine like the parts at near points; None if distant

    All may carry gradients.
    """

    distant: bool
    place: Vector3f
    normal: Vector3f
    power: Color3f
    area: Float
    facets: Facets | None = None

    @property
    def count(self) -> int:
        """N."""
        return dr.width(self.place)

    def centre(self) -> Vector3f:
        """Vector3f of width 1, the mean position by area. Attached."""
        total = dr.sum(self.area)
        return mi.Vector3f(*(dr.sum(self.place[c] * self.area) / total for c in range(3)))

    def radius_towards(self, p_world: Point3f) -> Float:
        """Float, radius of a disk of the area that points see of the light, if nothing hides it. Attached."""
        direction: Vector3f = dr.normalize(mi.Vector3f(p_world) - self.centre())
        # The mean normal times the whole area is the area vector of what faces one way; closed surfaces show a quarter of theirs.
        total = dr.sum(self.area)
        facing = mi.Vector3f(*(dr.sum(self.normal[c] * self.area) for c in range(3)))
        straight: Float = dr.dot(facing, direction)
        flat = dr.maximum(straight, 0)
        closed = 0.25 * (total - dr.norm(facing))
        return dr.sqrt(dr.maximum(flat + closed, 1e-12 * total) * (1 / math.pi))

    def table(self) -> SampleTable:
        """The samples in packets of four numbers, for look-ups by many lanes."""
        p, c = self.place, self.power
        colour = [c[k] for k in range(dr.size_v(type(c)))]
        rows = [mi.Vector4f(p.x, p.y, p.z, 0), mi.Vector4f(*colour, *[mi.Float(0)] * (4 - len(colour)))]
        if self.facets:
            rows += self.facets.packets()
        packets = tuple(ravel(row) for row in rows)
        dr.eval(packets)
        count, flat, far = (self.facets.count, self.facets.flat, self.facets.far) if self.facets else (1, True, False)
        return SampleTable(self.distant, self.count, packets, count, flat, far)


@dataclass(frozen=True)
class SampleTable:
    """:class:`LightSamples` as flat buffers of four numbers for each sample, and :class:`Facets` likewise."""

    distant: bool
    count: int
    packets: tuple[Float, ...]
    facets: int
    flat: bool
    far: bool

    def place(self, index: UInt32) -> Vector3f:
        """Vector3f, place of sample ``index`` (UInt32), detached."""
        packet = dr.gather(mi.Vector4f, dr.detach(self.packets[0]), index)
        return mi.Vector3f(packet.x, packet.y, packet.z)

    def from_sky(self, index: UInt32) -> tuple[Vector3f, Color3f]:
        """(wo, weight) of direction ``index`` (UInt32) of a light infinitely far away, the same at all points. Attached."""
        place = _packet(self.packets[0], index)
        return mi.Vector3f(-place.x, -place.y, -place.z), self._power(index)

    def _power(self, index: UInt32) -> Color3f:
        colour = _packet(self.packets[1], index)
        return mi.UnpolarizedSpectrum(*(colour[k] for k in range(dr.size_v(mi.UnpolarizedSpectrum))))

    def illuminate(self, index: UInt32, p_world: Point3f, sides: Sequence[Vector3f]) -> list[tuple[Vector3f, Color3f, Bool]]:
        """(wo, weight, reached) of sample ``index`` (UInt32) at points, for the light on each of some sides of them.

        wo is a unit direction (Vector3f) to the light in the mean, weight its irradiance on a surface that faces it (colour), and
        reached (Bool) tells where it arrives. That does not ask for its radiance, whose derivative is there even if it is zero.

        ``p_world`` Point3f (P,), world space; ``sides``: normals (unit Vector3f (P,)) that point to these sides. Weight times
        cosine is right also where the horizon cuts the light in two. Light from infinitely far away is on one side. Attached to
        points, normals and samples. One-sided, as Mitsuba's area lights are.
        """
        if self.distant:
            return [(*self.from_sky(index), mi.Bool(True))]
        power, found = self._power(index), []
        for vector in (self._from_afar if self.far else self._from_nearby)(index, p_world, sides):
            direction, irradiance, reached = direction_and_length(vector)
            found.append((direction, power * irradiance, reached))
        return found

    def _from_nearby(self, index: UInt32, p_world: Point3f, sides: Sequence[Vector3f]) -> list[Vector3f]:
        """Irradiance vector (Vector3f) of a sample's disks on each side of points, for a power of 1."""
        vectors = [mi.Vector3f(0) for _ in sides]
        for k in range(self.facets):
            disk = self._disk(index, k, p_world)
            along, across = disk_irradiance(disk.squared, disk.height, disk.squared_radius)
            vector = disk.offset * along - disk.normal * across
            for i, side in enumerate(sides):
                vectors[i] += _above(vector, along, side, dr.dot(disk.offset, side), disk.reach(side), disk.squared) * disk.size
        return vectors

    def _from_afar(self, index: UInt32, p_world: Point3f, sides: Sequence[Vector3f]) -> list[Vector3f]:
        """The same from points that see the disks as points, and a sample's disks in about one direction.

        The horizon cuts all of them at once, by the mean and the variance of their levels above it.
        """
        vector, total, squares = mi.Vector3f(0), mi.Float(0), [mi.Float(0) for _ in sides]
        for k in range(self.facets):
            disk = self._disk(index, k, p_world)
            along = dr.maximum(disk.height, 0) * dr.square(dr.rcp(disk.squared + disk.squared_radius)) * disk.size
            vector += disk.offset * along
            total += along
            for i, side in enumerate(sides):
                squares[i] += along * (dr.square(dr.dot(disk.offset, side)) + (1 / 3) * disk.reach(side))
        share = dr.rcp(dr.maximum(total, 1e-30))
        squared, vectors = dr.squared_norm(vector) * dr.square(share), []
        for side, own in zip(sides, squares, strict=True):
            level = dr.dot(vector, side) * share
            vectors.append(_above(vector, total, side, level, 3 * (own * share - dr.square(level)), squared))
        return vectors

    def _disk(self, index: UInt32, k: int, p_world: Point3f) -> _Disk:
        """Disk number ``k`` of sample ``index`` (UInt32), seen from points."""
        middle, n = (_packet(packet, index * self.facets + k) for packet in self.packets[2:])
        offset, normal = mi.Vector3f(middle.x, middle.y, middle.z) - mi.Vector3f(p_world), mi.Vector3f(n.x, n.y, n.z)
        size = mi.Float(1)
        if self.facets > 1:
            size = dr.squared_norm(normal)
            inverse = dr.rsqrt(dr.maximum(size, 1e-20))
            normal, size = normal * inverse, size * inverse
        squared, height = dr.squared_norm(offset), -dr.dot(normal, offset)
        if not self.flat:
            height = _shown(height, 1.06 * middle.w * n.w, 1.5 * dr.square(n.w) * (squared - dr.square(height)), squared)
        return _Disk(offset, normal, size, squared, height, dr.square(middle.w))


@dataclass(frozen=True)
class _Disk:
    """A disk seen from points. ``offset``: of its centre; ``normal``: unit; ``size``: its share of its sample; ``squared``:
    distance; ``height``: of the points above it. All attached."""

    offset: Vector3f
    normal: Vector3f
    size: Float
    squared: Float
    height: Float
    squared_radius: Float

    def reach(self, side: Vector3f) -> Float:
        """Squared distance (Float): evenly spread so far above and below the disk's centre, points have as much light above it
        as those of the disk. ``side``: upward direction (unit)."""
        return 0.72 * self.squared_radius * (1 - dr.square(dr.dot(self.normal, side)))


def _above(vector: Vector3f, along: Float, side: Vector3f, level: Float, variance: Float, squared: Float) -> Vector3f:
    """Irradiance (Vector3f) of the part of a disk on one side of planes. The whole disk gives ``vector``.

    ``level``: of the disk's centre above the plane, around which its points are spread evenly, with a ``variance`` of a third.
    """
    variance = dr.maximum(variance, dr.maximum(1e-8 * squared, 1e-20))
    inverse = dr.rsqrt(variance)
    reach = variance * inverse
    place: Float = dr.fma(0.5 * level, inverse, 0.5)
    share = dr.clip(place, 0, 1)
    upright = dr.dot(vector, side)
    higher = dr.maximum(upright + along * dr.square(1 - share) * reach, 0)
    return dr.select(share > 0, vector * share + side * (higher - upright * share), 0)


def disk_irradiance(squared_distance: Float, height: Float, squared_radius: Float) -> tuple[Float, Float]:
    """(along, across): along * offset - across * normal is the vector whose product with a unit normal is the irradiance of a
    disk of radiance 1, divided by the disk's area.

    That is if all of it is in front of the surface. Exact at any distance; 0 behind the disk. Bounded, as are its derivatives:
    those next to the rim are smaller. Attached to all.

    Args:
        squared_distance: Float, from the point to the disk's centre.
        height: Float, of the point above the disk's plane, on the side that shines.
        squared_radius: Float.

    Source: elements parallel to a disk and perpendicular to it in Howell, "A Catalog of Radiation Heat Transfer Configuration
    Factors"; here without differences of numbers that are nearly the same.
    """
    rise = dr.square(height)
    inner, outer = squared_distance - squared_radius, squared_distance + squared_radius
    square = dr.maximum(dr.square(inner) + squared_radius * dr.fma(4, rise, 1e-4 * squared_radius), 1e-22)
    inverse = dr.rsqrt(square)
    root = square * inverse
    scale = dr.select(height > 0, 2 * inverse, 0)
    along = scale * dr.rcp(root + outer)
    near = inner < 0
    axial = dr.select(near, root - inner, rise) * dr.rcp(dr.select(near, dr.maximum(4 * squared_radius, 1e-18), root + inner))
    return along * height, scale * axial - along * rise


def _shown(height: Float, rise: Float, variance: Float, squared: Float) -> Float:
    """Mean height (Float) above what is seen of a facet: what bends turns away little by little.

    ``height``: above its disk; ``rise``: of the planes through its pieces above that, in the mean, around which they are spread
    evenly, with a ``variance`` of a third.
    """
    variance = dr.maximum(variance, dr.maximum(1e-8 * squared, 1e-20))
    inverse = dr.rsqrt(variance)
    place: Float = dr.fma(0.5 * (height - rise), inverse, 0.5)
    share = dr.clip(place, 0, 1)
    return dr.select(share < 1, share * dr.fma(share, variance * inverse, rise), height)


def _packet(flat: Float, index: UInt32) -> Vector4f:
    return dr.gather(mi.Vector4f, flat, index, mode=dr.ReduceMode.Local)


def brightness(name: str, radiance: Color3f, count: int) -> np.ndarray:
    """Mean over the channels of radiances (colour, ``count``), on the host, at least 0.

    Raises ``ShadowmapError`` if one is not finite: sums over parts would lose it, and the light would just be dark.
    """
    mean = dr.mean(mi.UnpolarizedSpectrum(radiance)) + dr.zeros(mi.Float, count)
    values = mean.numpy().astype(np.float64)
    if not np.isfinite(values).all():
        raise ShadowmapError(f"The radiance of light '{name}' is not finite everywhere: check its values for NaN or inf.")
    return np.maximum(values, 0)


def cluster_sums(values: ArrayT, cluster: UInt32, count: int) -> ArrayT:
    """Sums of ``values`` (Float or vector, P) over the pieces that belong to each of ``count`` clusters (UInt32, P). Attached."""
    whole: Any = values  # Any: a number or a vector
    if dr.depth_v(whole) == 1:
        total: Any = dr.custom(_Sums, mi.Float(whole), cluster, count)  # Any: of the same type
        return total
    return type(whole)(*(cluster_sums(whole[k], cluster, count) for k in range(len(whole))))


class _Sums(dr.CustomOp):
    """Scatter-add whose derivatives are evaluated at once. If a loop reads pending derivatives, Dr.Jit ends the process."""

    def eval(self, values: Float, cluster: UInt32, count: int) -> Float:
        self._cluster, self._count = cluster, count
        total = dr.zeros(mi.Float, count)
        dr.scatter_add(total, values, cluster)
        dr.eval(total)
        return total

    def forward(self) -> None:
        total = dr.zeros(mi.Float, self._count)
        dr.scatter_add(total, self.grad_in("values"), self._cluster)
        dr.eval(total)
        self.set_grad_out(total)

    def backward(self) -> None:
        self.set_grad_in("values", dr.gather(mi.Float, self.grad_out(), self._cluster))

    def name(self) -> str:
        return "cluster sums"

"""What an extended light is to the shading: a fixed number of points, or of directions, each with a shadow map of its own."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import ShadowmapError

# Which entries of a covariance of unit vectors are kept: the last one follows from the mean vector's length.
BEND = ((0, 0), (1, 1), (0, 1), (0, 2), (1, 2))


@dataclass(frozen=True)
class LightSamples:
    """N points of a light that is near (an area light), or N directions of one that is infinitely far away.

    distant  which of the two (static)
    place    Vector3f (N,), positions, or unit directions in which light travels, world space
    normal   Vector3f (N,), mean normals of the parts, shorter than 1 where these are curved (unused if distant)
    power    colour (N,), radiance times area, or irradiance on a surface that faces the light
    area     Float (N,), share of the emitter's area (unused if distant)
    bend     Float (N,) for each of :data:`BEND`, covariance of the normals of each part, or None where the emitter is flat

    All may carry gradients.
    """

    distant: bool
    place: Any
    normal: Any
    power: Any
    area: Any
    bend: tuple[Any, ...] | None = None

    @property
    def count(self) -> int:
        """N."""
        return dr.width(self.place)

    def centre(self) -> Any:
        """Vector3f of width 1, the mean position by area. Attached."""
        total = dr.sum(self.area)
        return mi.Vector3f(*(dr.sum(self.place[c] * self.area) / total for c in range(3)))

    def radius_towards(self, p_world: Any) -> Any:
        """Float, radius of a disk of the area that points see of the light, if nothing hides it. Attached."""
        direction = dr.normalize(mi.Vector3f(p_world) - self.centre())
        # The mean normal times the whole area is the area vector of what faces one way; closed surfaces show a quarter of theirs.
        total = dr.sum(self.area)
        facing = mi.Vector3f(*(dr.sum(self.normal[c] * self.area) for c in range(3)))
        flat = dr.maximum(dr.dot(facing, direction), 0)
        closed = 0.25 * (total - dr.norm(facing))
        return dr.sqrt(dr.maximum(flat + closed, 1e-12 * total) * (1 / math.pi))

    def table(self) -> SampleTable:
        """The same numbers in packets, for look-ups by many lanes."""
        p, n, c = self.place, self.normal, self.power
        colour = [c[k] for k in range(dr.size_v(type(c)))]
        rows = [mi.Vector4f(p.x, p.y, p.z, self.area), mi.Vector4f(*colour, *[mi.Float(0)] * (4 - len(colour)))]
        if not self.distant:
            rows.append(mi.Vector4f(n.x, n.y, n.z, self.bend[0] if self.bend else 0))
            if self.bend:
                rows.append(mi.Vector4f(*self.bend[1:]))
        packets = tuple(dr.ravel(row) for row in rows)
        dr.eval(packets)
        return SampleTable(self.distant, self.count, packets)


@dataclass(frozen=True)
class SampleTable:
    """:class:`LightSamples` as flat buffers of four numbers for each sample."""

    distant: bool
    count: int
    packets: tuple[Any, ...]

    def place(self, index: Any) -> Any:
        """Vector3f, where sample ``index`` (UInt32) is, detached."""
        packet = dr.gather(mi.Vector4f, dr.detach(self.packets[0]), index)
        return mi.Vector3f(packet.x, packet.y, packet.z)

    def illuminate(self, index: Any, p_world: Any) -> tuple[Any, Any, Any]:
        """(wo, weight, reached): unit direction from points to sample ``index`` (UInt32), its irradiance on a surface that faces
        it, and where (Bool) its light arrives. That does not ask for its radiance, whose derivative is there even if it is zero.

        ``p_world`` Point3f (P,), world space. Attached to points and samples. One-sided, as Mitsuba's area lights are.
        """
        place, colour, *rest = (_packet(packet, index) for packet in self.packets)
        channels = dr.size_v(mi.UnpolarizedSpectrum)
        power = mi.UnpolarizedSpectrum(*(colour[k] for k in range(channels)))
        where = mi.Vector3f(place.x, place.y, place.z)
        if self.distant:
            return -where, power, mi.Bool(True)
        offset = where - mi.Vector3f(p_world)
        squared = dr.squared_norm(offset)
        # A point on the light's own surface may be the sample itself.
        valid = squared > 0
        wo = offset * dr.rsqrt(dr.select(valid, squared, 1))
        n = rest[0]
        normal = mi.Vector3f(n.x, n.y, n.z)
        cosine = -dr.dot(normal, wo)
        cosine = _mean_cosine(cosine, _spread(normal, n.w, rest[1], wo)) if len(rest) > 1 else dr.maximum(cosine, 0)
        # The share of a disk of this area in the view of a point on its axis: exact at any distance, and never infinite.
        form = cosine * dr.rcp(dr.maximum(squared + place.w * (1 / math.pi), 1e-20))
        return wo, power * form, dr.detach(form) > 0


def _spread(normal: Any, xx: Any, others: Any, wo: Any) -> Any:
    """How far the cosines of a part's own normals lie on either side of their mean (Float), if they are spread evenly."""
    yy, xy, xz, yz = others
    zz = 1 - dr.squared_norm(normal) - xx - yy
    variance = xx * wo.x * wo.x + yy * wo.y * wo.y + zz * wo.z * wo.z
    variance += 2 * (xy * wo.x * wo.y + xz * wo.x * wo.z + yz * wo.y * wo.z)
    # The least keeps the derivative of the root finite.
    return dr.sqrt(dr.maximum(3 * variance, 1e-8))


def _mean_cosine(cosine: Any, spread: Any) -> Any:
    """Mean of what is positive of cosines spread evenly around ``cosine``: parts that turn away do so little by little."""
    partly = dr.square(cosine + spread) * dr.rcp(4 * spread)
    return dr.select(dr.abs(cosine) < spread, partly, dr.maximum(cosine, 0))


def _packet(flat: Any, index: Any) -> Any:
    return dr.gather(mi.Vector4f, flat, index, mode=dr.ReduceMode.Local)


def brightness(name: str, radiance: Any, count: int) -> np.ndarray:
    """Mean over the channels of radiances (colour, ``count``), on the host, at least 0.

    Raises ``ShadowmapError`` if one is not finite: sums over parts would lose it, and the light would just be dark.
    """
    mean = dr.mean(mi.UnpolarizedSpectrum(radiance)) + dr.zeros(mi.Float, count)
    values = mean.numpy().astype(np.float64)
    if not np.isfinite(values).all():
        raise ShadowmapError(f"The radiance of light '{name}' is not finite everywhere: check its values for NaN or inf.")
    return np.maximum(values, 0)


def cluster_sums(values: Any, cluster: Any, count: int) -> Any:
    """Sums of ``values`` (Float or vector, P) over the pieces that belong to each of ``count`` clusters (UInt32, P). Attached."""
    if dr.depth_v(values) == 1:
        return dr.custom(_Sums, mi.Float(values), cluster, count)
    return type(values)(*(cluster_sums(values[k], cluster, count) for k in range(len(values))))


class _Sums(dr.CustomOp):
    """Scatter-add whose derivatives are evaluated at once: pending ones end the process where a loop comes to read them."""

    def eval(self, values: Any, cluster: Any, count: int) -> Any:
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

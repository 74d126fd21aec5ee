"""Environments: sample directions, each for a part of the sky."""

from __future__ import annotations

import functools
import operator
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...jit.arrays import device_array, ravel
from ...jit.types import Float, UInt32, Vector3f
from ...scene.changes import fingerprint
from ...scene.geometry import Geometry
from ...scene.lights.environment import Environment
from ...scene.mitsuba_objects import parameters
from .clusters import sky_clusters
from .samples import LightSamples, brightness, cluster_sums

# Rows of the grid on which a sky is measured: as many as its image has, within bounds.
_ROWS = (64, 1024)
# Importance of dark parts, in units of the mean: light may appear there during an optimisation.
_DARK = 0.05
# A sky is divided anew when so much of its energy has come to shine elsewhere.
_MOVED = 0.25
# Importance of what lies behind a floor.
_HIDDEN = 0.1


@dataclass(frozen=True)
class SkyPlan:
    """The parts of a sky. Static; made once for a scene.

    rows       of the latitude-longitude grid, with twice as many columns
    cluster    UInt32 (P,), the part that each of its cells belongs to
    direction  Vector3f (N,), unit, towards the centre of each part, in the environment's own space
    length     Float (N,), length of the mean of a part's directions: the wider it is, the shorter
    axes       three Vector3f (N,), principal axes of a part's directions, as long as these deviate along them
    """

    rows: int
    cluster: UInt32
    direction: Vector3f
    length: Float
    axes: tuple[Vector3f, Vector3f, Vector3f]


def plan_sky(light: Environment, count: int, geometry: Geometry) -> SkyPlan:
    """Divide a sky into ``count`` parts of about the same energy (on the host, once).

    Light from below a floor that everything stands on reaches nothing, so parts below it are large.
    """
    rows = int(np.clip(light.rows, *_ROWS))
    bright, weight = _measured(light, rows)
    with dr.suspend_grad():
        local, _ = _grid(rows)
        directions, world = (np.stack([c.numpy() for c in v], -1).astype(np.float64) for v in (local, light.to_world(local)))
    average = (bright * weight).sum() / weight.sum()
    energy = (bright + _DARK * average if average > 0 else np.ones_like(bright)) * weight
    hidden: npt.NDArray[np.bool_] = np.zeros((rows, 2 * rows), bool)
    for normal, least in _floors(geometry):
        hidden |= (world @ normal < -least).reshape(rows, 2 * rows)
    cluster = _divided(energy.reshape(rows, 2 * rows), hidden, count).ravel()
    centre = np.stack([np.bincount(cluster, energy * directions[:, c], count) for c in range(3)], -1)
    # Opposite directions of one part may cancel: its heaviest cell then stands for it.
    length = np.linalg.norm(centre, axis=-1)
    order = np.lexsort((-energy, cluster))
    heaviest = directions[order[np.searchsorted(cluster[order], np.arange(count))]]
    cancelled = length < 1e-3 * np.bincount(cluster, energy, count)
    centre = np.where(cancelled[:, None], heaviest, centre / np.maximum(length, 1e-300)[:, None])
    length, axes = _extent(directions, energy, cluster, centre)
    direction, first, second, third = (_vectors(v) for v in (centre, *axes))
    return SkyPlan(rows, device_array(mi.UInt32, cluster), direction, device_array(mi.Float, length), (first, second, third))


def _vectors(rows: np.ndarray) -> Vector3f:
    return mi.Vector3f(*(device_array(mi.Float, column) for column in rows.T))


def _extent(
    directions: np.ndarray, energy: np.ndarray, cluster: np.ndarray, centre: np.ndarray
) -> tuple[np.ndarray, list[np.ndarray]]:
    """(lengths of the mean directions of parts (N,), their three principal axes (N, 3)); ``centre``: their unit directions.

    Parts larger than half the sky count as a point: most of them lies behind any surface.
    """
    count = len(centre)
    total = np.maximum(np.bincount(cluster, energy, count), 1e-300)
    moments = np.empty((count, 3, 3))
    for i in range(3):
        for j in range(3):
            moments[:, i, j] = np.bincount(cluster, energy * directions[:, i] * directions[:, j], count) / total
    mean = np.stack([np.bincount(cluster, energy * directions[:, c], count) for c in range(3)], -1) / total[:, None]
    length = (mean * centre).sum(-1)
    variances, axes = np.linalg.eigh(moments - mean[:, :, None] * mean[:, None, :])
    point = length < 0.5
    scaled = axes * np.sqrt(np.maximum(variances, 0))[:, None, :] * ~point[:, None, None]
    return np.where(point, 1, np.minimum(length, 1)), [scaled[:, :, k] for k in range(3)]


def _divided(energy: np.ndarray, hidden: npt.NDArray[np.bool_], count: int) -> np.ndarray:
    """Parts of a sky; fewer in hidden rows, if these are all at the upper or the lower end: no part shall be partly hidden."""
    full, some = np.asarray(hidden.all(1)), hidden.any(1)
    edge = int(np.argmin(full)) if full[0] else len(full) - int(np.argmin(full[::-1]))
    above = bool(full[0])
    split = 0 < edge < len(full) and (full[:edge] == above).all() and (full[edge:] != above).all()
    if count == 1 or not split or (full != some).any():
        return sky_clusters(energy, count)
    weights = (_HIDDEN if above else 1) * energy[:edge].sum(), (1 if above else _HIDDEN) * energy[edge:].sum()
    upper = int(np.clip(round(count * weights[0] / sum(weights)), 1, count - 1))
    parts = sky_clusters(energy[:edge], upper), sky_clusters(energy[edge:], count - upper) + np.uint32(upper)
    return np.concatenate(parts)


def _measured(light: Environment, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """(brightness, solid angle) of the cells of a grid, read back."""
    with dr.suspend_grad():
        local, solid_angle = _grid(rows)
        radiance = mi.UnpolarizedSpectrum(light.diffuse_radiance(light.to_world(local)))
        return brightness(light.name, radiance, dr.width(solid_angle)), solid_angle.numpy().astype(np.float64)


class SkyWatch:
    """Watch over the distribution of a sky's light, which may have been turned since the sky was divided into parts.

    Args:
        lights: environments of a scene.
    """

    def __init__(self, lights: Sequence[Environment]) -> None:
        self._lights = tuple(lights)
        self._rows = [int(np.clip(light.rows, *_ROWS)) for light in lights]
        self._shares = [_shares(light, rows) for light, rows in zip(lights, self._rows, strict=True)]
        self._versions = [_version(light) for light in lights]

    def same(self) -> bool:
        """True if the environments shine as before. Reads back only the parameters changed since the last call."""
        for k, (light, rows) in enumerate(zip(self._lights, self._rows, strict=True)):
            version = _version(light)
            if version == self._versions[k]:
                continue
            if 0.5 * np.abs(_shares(light, rows) - self._shares[k]).sum() > _MOVED:
                return False
            self._versions[k] = version
        return True


def _shares(light: Environment, rows: int) -> np.ndarray:
    """Share of each cell in the energy of a sky."""
    bright, weight = _measured(light, rows)
    energy = bright * weight
    return energy / energy.sum() if energy.sum() > 0 else weight / weight.sum()


def _version(light: Environment) -> tuple[Any, ...]:
    """A value that changes when a parameter other than ``to_world`` does."""
    held = (value for key, value in parameters(light.emitter).items() if key not in ("to_world", "sampling_weight"))
    return tuple(fingerprint(value) for value in held)


def _floors(geometry: Geometry) -> list[tuple[np.ndarray, float]]:
    """(unit normal, sine) of flat shapes that all others lie in front of, and over, as their box goes.

    Nothing is lit from directions that are further behind such a plane than by the angle of this sine: past the floor's edge.
    """
    positions = dr.detach(geometry.positions).numpy().reshape(-1, 3).astype(np.float64)
    parts = [positions[i.vertex_start : i.vertex_start + i.vertex_count] for i in geometry.shapes]
    found = []
    for k, own in enumerate(parts):
        others = [part for j, part in enumerate(parts) if j != k]
        if not geometry.shapes[k].planar or not others:
            continue
        rest = np.concatenate(others)
        centre = own.mean(0)
        axes = np.linalg.svd(own - centre, full_matrices=False)[2]
        across, height = (own - centre) @ axes[:2].T, (rest - centre) @ axes[2]
        over = (rest - centre) @ axes[:2].T
        tolerance = 1e-3 * np.ptp(own, axis=0).max()
        if (over < across.min(0) - tolerance).any() or (over > across.max(0) + tolerance).any():
            continue
        room = min((over.min(0) - across.min(0)).min(), (across.max(0) - over.max(0)).min())
        for sign in (1, -1):
            top = float((sign * height).max())
            if (sign * height).min() >= -tolerance and top > tolerance:
                found.append((sign * axes[2], top / max(float(np.hypot(top, room)), 1e-12)))
    return found


#: Fields with defaults cannot precede these; all samples of skies have them.
NOT_GIVEN: Any = None  # Any: takes the place of arrays


@dataclass(frozen=True)
class SkySamples(LightSamples):
    """Directions of an environment, and the widths of their parts.

    length, axes  as of :class:`SkyPlan`, axes in world space, attached to the environment's rotation
    """

    length: Float = NOT_GIVEN
    axes: tuple[Vector3f, Vector3f, Vector3f] = NOT_GIVEN

    def widths(self) -> SkyWidths:
        """The widths in packets, for look-ups by many lanes."""
        first, second, third = self.axes
        packets = (
            ravel(mi.Vector4f(first.x, first.y, first.z, self.length)),
            ravel(mi.Vector4f(second.x, second.y, second.z, third.x)),
            ravel(mi.Vector2f(third.y, third.z)),
        )
        dr.eval(packets)
        return SkyWidths(packets)


@dataclass(frozen=True)
class SkyWidths:
    """Widths of the parts of a sky as flat buffers."""

    packets: tuple[Float, Float, Float]

    def of(self, index: UInt32, normal: Vector3f) -> tuple[Float, Float]:
        """(length, half): length of the mean of the directions of part ``index`` (UInt32, P), and how far their cosines to a unit
        ``normal`` (Vector3f, P) lie on either side of the mean cosine, if they are spread evenly (Float). Attached to both.
        """
        a, b = (dr.gather(mi.Vector4f, packet, index, mode=dr.ReduceMode.Local) for packet in self.packets[:2])
        c = dr.gather(mi.Vector2f, self.packets[2], index, mode=dr.ReduceMode.Local)
        axes = (mi.Vector3f(a.x, a.y, a.z), mi.Vector3f(b.x, b.y, b.z), mi.Vector3f(b.w, c.x, c.y))
        variance = functools.reduce(operator.add, (dr.square(dr.dot(axis, normal)) for axis in axes))
        # The least keeps the derivative of the root finite.
        return a.w, dr.sqrt(dr.maximum(3 * variance, 1e-8))


def sky_samples(light: Environment, plan: SkyPlan) -> SkySamples:
    """Current samples of an environment. Attached to all of its radiance, and to its rotation."""
    local, solid_angle = _grid(plan.rows)
    radiance = mi.UnpolarizedSpectrum(light.diffuse_radiance(light.to_world(local)))
    count = dr.width(plan.direction)
    power = cluster_sums(radiance * solid_angle, plan.cluster, count)
    first, second, third = (light.to_world(axis) for axis in plan.axes)
    towards, axes = -light.to_world(plan.direction), (first, second, third)
    return SkySamples(True, towards, mi.Vector3f(0), power, mi.Float(0), length=plan.length, axes=axes)


def _grid(rows: int) -> tuple[Vector3f, Float]:
    """(unit directions Vector3f, solid angles Float) of the cells of a latitude-longitude grid, as ``envmap`` lays out images."""
    columns = 2 * rows
    lane = dr.arange(mi.UInt32, rows * columns)
    row = lane // columns
    theta = (mi.Float(row) + 0.5) * (np.pi / rows)
    phi = (mi.Float(lane - row * columns) + 0.5) * (2 * np.pi / columns)
    sin_theta, cos_theta = dr.sincos(theta)
    sin_phi, cos_phi = dr.sincos(phi)
    # The integral of sin(theta) over a row, so that all solid angles add up to that of the sphere.
    solid_angle = sin_theta * float(2 * np.sin(0.5 * np.pi / rows) * 2 * np.pi / columns)
    return mi.Vector3f(sin_phi * sin_theta, cos_theta, -cos_phi * sin_theta), solid_angle

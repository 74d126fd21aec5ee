"""Ways to change a scene's parameters by one number: functions of (value at rest, number) that return the changed value.

Values are what ``mi.traverse`` gives: flat vertices, transformations, colours, textures. They are attached to the number.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

Change = Callable[[Any, Any], Any]


def translated(x: float, y: float, z: float, first: int = 0) -> Change:
    """Vertices, from number ``first`` on, or a position moved along a direction."""

    def change(rest: Any, t: Any) -> Any:
        if isinstance(rest, mi.Float):
            p = dr.unravel(mi.Point3f, rest)
            moves = dr.arange(mi.UInt32, dr.width(p)) >= first
            return dr.ravel(p + dr.select(moves, mi.Vector3f(x, y, z) * t, 0))
        return rest + mi.Vector3f(x, y, z) * t

    return change


def turned(axis: tuple[float, float, float], centre: tuple[float, float, float]) -> Change:
    """Vertices turned rigidly about an axis through a point; radians."""
    return lambda rest, t: dr.ravel(_rotation(axis, centre, t) @ dr.unravel(mi.Point3f, rest))


def scaled(centre: tuple[float, float, float]) -> Change:
    """Vertices scaled about a point."""
    return lambda rest, t: dr.ravel((dr.unravel(mi.Point3f, rest) - mi.Point3f(centre)) * (1 + t) + mi.Point3f(centre))


def waved(frequency: float) -> Change:
    """Each vertex goes its own way, neighbours nearly the same: a smooth deformation."""

    def change(rest: Any, t: Any) -> Any:
        p = dr.unravel(mi.Point3f, rest)
        q = dr.detach(p) * frequency
        return dr.ravel(p + t * mi.Vector3f(dr.sin(q.y + 1), dr.cos(2 * q.z + q.x), dr.sin(q.x - 1.5 * q.y)))

    return change


def one_corner(index: int, x: float, y: float, z: float) -> Change:
    """A single corner moved along a direction: a vertex, and all others at the same place."""

    def change(rest: Any, t: Any) -> Any:
        p = dr.unravel(mi.Point3f, rest)
        corner = dr.gather(mi.Point3f, dr.detach(rest), mi.UInt32(index))
        here = dr.norm(dr.detach(p) - corner) < 1e-5
        return dr.ravel(p + dr.select(here, mi.Vector3f(x, y, z) * t, 0))

    return change


def controlled(x: float, y: float, z: float, radius: float = 0.0, only: int | None = None) -> Change:
    """All control points of curves, or only one, moved along a direction, and their radii increased."""

    def change(rest: Any, t: Any) -> Any:
        way = np.zeros((dr.width(rest) // 4, 4), np.float32)
        way[slice(None) if only is None else only] = (x, y, z, radius)
        return rest + t * mi.Float(way.ravel())

    return change


def moved(x: float, y: float, z: float) -> Change:
    """A transformation, after which everything is moved along a direction."""
    return lambda rest, t: mi.Transform4f().translate(mi.Vector3f(x, y, z) * t) @ rest


def stretched(x: float, y: float, z: float) -> Change:
    """A transformation, before which everything is scaled along the axes."""
    return lambda rest, t: rest @ mi.Transform4f().scale(1 + t * mi.Vector3f(x, y, z))


def swung(axis: tuple[float, float, float], centre: tuple[float, float, float] = (0, 0, 0)) -> Change:
    """A transformation, after which everything is turned about an axis through a point; radians."""
    return lambda rest, t: _rotation(axis, centre, t) @ rest


def swung_locally(axis: tuple[float, float, float]) -> Change:
    """A transformation, before which everything is turned about an axis through the origin; radians."""
    return lambda rest, t: rest @ _rotation(axis, (0, 0, 0), t)


def brighter(rest: Any, t: Any) -> Any:
    """A colour, texture or number multiplied by 1 + t."""
    return mi.TensorXf(rest.array * (1 + t), rest.shape) if dr.is_tensor_v(rest) else rest * (1 + t)


def increased(by: float = 1.0) -> Change:
    """A number increased."""
    return lambda rest, t: rest + by * t


def lightened(top: int, bottom: int, left: int, right: int) -> Change:
    """A texture or the map of a sky with some rows and columns of texels increased."""

    def change(rest: Any, t: Any) -> Any:
        mask = np.zeros(rest.shape, np.float32)
        mask[top:bottom, left:right] = 1
        return mi.TensorXf(rest.array + t * mi.Float(mask.ravel()), rest.shape)

    return change


def repainted(seed: int) -> Change:
    """A texture plus noise."""

    def change(rest: Any, t: Any) -> Any:
        noise = np.random.default_rng(seed).uniform(-0.5, 0.5, dr.width(rest.array)).astype(np.float32)
        return mi.TensorXf(rest.array + t * mi.Float(noise), rest.shape)

    return change


def _rotation(axis: tuple[float, float, float], centre: tuple[float, float, float], radians: Any) -> Any:
    unit = np.asarray(axis, float) / np.linalg.norm(axis)
    to = mi.Transform4f().translate(mi.Vector3f(centre))
    back = mi.Transform4f().translate(-mi.Vector3f(centre))
    return to @ mi.Transform4f().rotate(mi.Vector3f(unit), dr.rad2deg(radians)) @ back

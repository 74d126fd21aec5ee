"""Cameras at the lights: axes, frusta, and projections.

A light sees the scene through one map (directional: orthographic; spot: perspective) or six (point: the faces of a cube). The
maps of all lights form one batch of M images. Axes and origins are attached to the lights' parameters. The frustum (the part of
the light's image plane that the map covers) is detached and stable, so that an optimisation does not see the fit move.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar, cast

import drjit as dr
import numpy as np
import numpy.typing as npt

from ..jit.arrays import backend, device_array
from ..jit.broadcast import from_one_buffer, look_up
from ..jit.kernel_inputs import float_input, split
from ..jit.types import AnyArray, Bool, Float, Point3f, UInt32, Vector3f, Vector4f
from ..jit.vectors import unit
from .tiles import Group, Rows, TileNumbers, Tiles, rows_of

#: Half-angle (tangent) of one cube face, before the margin for the filter.
CUBE_FACE = 1.0


@dataclass(frozen=True)
class LightView:
    """One map's camera.

    Attributes:
        right, up, forward: orthonormal axes of width 1, world space; light travels along ``forward``.
        origin: position of the light in world space, or any point for a directional light.
        spread: tangent of the half-angle that the map may cover, or 0 for an orthographic map.
        limit: largest image coordinate that the map ever covers, margins included (for faces of a cube).
    """

    right: Vector3f
    up: Vector3f
    forward: Vector3f
    origin: Point3f
    spread: Float
    limit: Float | float = math.inf


@dataclass(frozen=True)
class Views:
    """Cameras of all M maps, see :class:`LightView`; arrays of width M. Attached to the lights.

    ``forward`` is the axis of depths: after :func:`with_depths_from_planes` it is not the light's direction, which is the cross
    product of ``right`` and ``up``.
    """

    right: Vector3f
    up: Vector3f
    forward: Vector3f
    origin: Point3f
    spread: Float
    limit: Float

    @property
    def count(self) -> int:
        return dr.width(self.spread)

    def columns(self) -> list[Float]:
        """All components, (M,) each, in a fixed order."""
        return [*self.right, *self.up, *self.forward, *self.origin, self.spread, self.limit]

    @classmethod
    def of(cls, columns: Sequence[Float]) -> Views:
        """Make views from the result of :meth:`columns`."""
        Array3f = backend(columns[0]).Array3f
        return cls(*(Array3f(*columns[k : k + 3]) for k in (0, 3, 6, 9)), *columns[12:])


@dataclass(frozen=True)
class Frusta:
    """Part of the image plane and of the depth range that each map covers; width M, detached.

    A point with light-space coordinates (x, y, z) has image coordinates (x, y) in an orthographic and (x, y) / z in a perspective
    view. The map covers image coordinates ``center +- half`` and depths from ``near`` to ``far``. It resolves depths from
    ``first`` on; the depths of casters before ``first`` do not matter, for they lie before all receivers. Behind ``last`` there
    are no casters. ``tiles``: parts of the image planes that the maps serve, None if each light has one map for all of it.
    """

    center_x: Float
    center_y: Float
    half_x: Float
    half_y: Float
    near: Float
    far: Float
    first: Float
    last: Float
    tiles: Tiles | None = field(default=None, kw_only=True)

    def part(self, first: int, count: int) -> Frusta:
        """Those of ``count`` maps from number ``first`` on."""
        index = dr.arange(backend(self.near).UInt32, count) + first
        tiles = None if self.tiles is None else self.tiles.rows(index)
        return Frusta(*(dr.gather(type(column), column, index) for column in self.columns()), tiles=tiles)

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Names of the numbers of the maps, without their tiles, in a fixed order."""
        return tuple(name for name in cls.__dataclass_fields__ if name != "tiles")

    def columns(self) -> list[Float]:
        """All numbers of the maps, (M,) each, in the order of :meth:`names`."""
        return [getattr(self, name) for name in self.names()]

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """All numbers, (M,) each, by name, to be stored."""
        stored = {name: np.array(getattr(self, name)) for name in self.__dataclass_fields__ if name != "tiles"}
        tiles = {} if self.tiles is None else {f"tiles.{name}": np.array(value) for name, value in vars(self.tiles).items()}
        return stored | tiles

    def with_arrays(self, stored: Mapping[str, npt.NDArray[Any]]) -> Frusta:
        """The same frusta with numbers of :meth:`arrays` instead of their own."""
        made = {name: device_array(type(self.near), value) for name, value in stored.items()}
        tiles = {name.removeprefix("tiles."): value for name, value in made.items() if name.startswith("tiles.")}
        own: dict[str, Any] = {name: value for name, value in made.items() if not name.startswith("tiles.")}
        # Stored fits of older versions have tiles without slopes.
        whole = Tiles.whole(backend(self.near), len(stored["near"]))
        return replace(self, **own, tiles=replace(whole, **tiles) if tiles else self.tiles)

    @classmethod
    def joined(cls, parts: Sequence[Frusta]) -> Frusta:
        """Those of the maps of all parts, one part after the other."""
        joined = cls(*(dr.concat(list(columns)) for columns in zip(*(part.columns() for part in parts), strict=True)))
        if all(part.tiles is None for part in parts):
            return joined
        tiles = [part.tiles or Tiles.whole(backend(part.near), dr.width(part.near)) for part in parts]
        return replace(joined, tiles=Tiles(*(dr.concat(list(c)) for c in zip(*(t.columns() for t in tiles), strict=True))))


# Least number of points that select from the numbers of maps, and most maps whose numbers are arrays of their own.
_MANY, _MOST_ROWS = 1 << 16, 16
# Names of the axis of depths among the numbers of tiles.
_FORWARD = ("forward_x", "forward_y", "forward_z")
ViewsOrFrusta = TypeVar("ViewsOrFrusta", Views, Frusta)


def directional_view(direction: Vector3f) -> LightView:
    """View along a light direction of any length, which also determines the other axes. Attached to the direction."""
    forward = unit(direction)
    # Build the frame from the world axis that is least aligned with the (detached) direction.
    d = dr.abs(dr.detach(forward))
    use_x = (d.x <= d.y) & (d.x <= d.z)
    use_y = ~use_x & (d.y <= d.z)
    vector = type(direction)
    axis = vector(dr.select(use_x, 1.0, 0.0), dr.select(use_y, 1.0, 0.0), dr.select(use_x | use_y, 0.0, 1.0))
    right = dr.normalize(dr.cross(axis, forward))
    zero = type(direction[0])(0)
    return LightView(right, dr.cross(forward, right), forward, vector(zero, zero, zero), zero)


def spot_view(position: Point3f, right: Vector3f, up: Vector3f, forward: Vector3f, tan_cutoff: Float) -> LightView:
    """View along the axis of a cone of light, up to a half-angle of 60 degrees (tangent 1.73); use a cube for wider cones."""
    return LightView(right, up, forward, position, tan_cutoff)


def cube_views(position: Point3f, resolution: int, filter_size: int) -> tuple[LightView, ...]:
    """Six views along the world axes, each slightly wider than 90 degrees, so that filters at a face's edge see its neighbour."""
    vector, scalar = type(position), type(position[0])
    wider = CUBE_FACE / (1.0 - 2.0 * (filter_size // 2 + 1) / resolution)
    spread = scalar(float_input(backend(position), "texels", wider))

    def axis(k: int, sign: float) -> Vector3f:
        return vector(*(scalar(sign if c == k else 0.0) for c in range(3)))

    views = []
    for k in range(3):
        for sign in (1.0, -1.0):
            forward, right = axis(k, sign), axis((k + 1) % 3, 1.0)
            views.append(LightView(right, dr.cross(forward, right), forward, position, spread, spread))
    return tuple(views)


def cube_face(offset: Vector3f) -> UInt32:
    """Index of the view among the six :func:`cube_views` that sees a point at ``offset`` from the light."""
    a = dr.abs(offset)
    k = dr.select((a.x >= a.y) & (a.x >= a.z), 0, dr.select(a.y >= a.z, 1, 2))
    component = dr.select(k == 0, offset.x, dr.select(k == 1, offset.y, offset.z))
    return backend(offset).UInt32(2 * k + dr.select(component < 0, 1, 0))


def stack_views(views: Sequence[LightView]) -> Views:
    """Collect single views into arrays of width M, keeping their gradients."""
    module = backend(views[0].spread)
    index = dr.arange(module.UInt32, len(views))

    def stack(values: list[Float]) -> Float:
        if len(values) == 1:
            return module.Float(values[0])
        total = module.Float(0)
        for k, value in enumerate(values):
            total = dr.select(index == k, value, total)
        return total

    def stack3(name: str) -> Vector3f:
        parts = [stack([getattr(v, name)[c] for v in views]) for c in range(3)]
        # The components of a single view are the caller's own arrays.
        return module.Array3f(*(from_one_buffer(parts) if dr.grad_enabled(parts) else parts))

    return Views(
        stack3("right"),
        stack3("up"),
        stack3("forward"),
        stack3("origin"),
        stack([v.spread for v in views]),
        stack([module.Float(v.limit) for v in views]),
    )


def of_map(table: ViewsOrFrusta, index: UInt32, count: int) -> ViewsOrFrusta:
    """Rows of :class:`Views` or :class:`Frusta` (of width ``count``) for the map ``index`` of each lane. Attached."""
    module = backend(index)

    def pick(value: AnyArray) -> AnyArray:
        # A single row broadcasts implicitly. But the adjoint of broadcasting is a separate reduction for each number, while
        # gathers share one kernel.
        if count == 1 and not dr.grad_enabled(value):
            return value
        if dr.depth_v(value) > 1:
            return module.Array3f(*(look_up(value[c], index) for c in range(3)))
        return look_up(cast("Float", value), index)

    columns = [getattr(table, name) for name in table.__dataclass_fields__ if name != "tiles"]
    if count > 1:
        dr.eval(columns)  # by one kernel: look-ups evaluate columns one by one
    rows: list[Any] = [pick(column) for column in columns]
    return type(table)(*rows)


def of_tile(numbers: TileNumbers, views: Views, tile: UInt32) -> tuple[Views, Frusta]:
    """Rows as of :func:`of_map` for the map ``tile``, one of a light's, of each lane. Detached.

    ``numbers``: from :func:`tile_numbers`; ``views``: of all maps.
    """
    module = backend(tile)
    common = of_map(dr.detach(views), module.UInt32(numbers.group[0]), views.count)
    frustum = Frusta(*numbers.at(Frusta.names(), tile))
    return replace(common, forward=module.Array3f(*numbers.at(_FORWARD, tile))), frustum


def tile_rows(views: Views, frusta: Frusta, points: int) -> Rows | None:
    """Numbers of all maps, from which many ``points`` select. Detached.

    None for few points or many maps, without tiles, and if the views are attached: points gather these numbers.
    """
    if frusta.tiles is None or points < _MANY or views.count > _MOST_ROWS or dr.grad_enabled(views):
        return None
    return rows_of(_numbers(views, frusta))


def tile_numbers(views: Views, frusta: Frusta, group: Group, rows: Rows | None) -> TileNumbers:
    """Numbers in which the maps of a light differ from each other. ``rows``: from :func:`tile_rows`. Detached.

    The tiles of a light share its camera; only the axis of depths is their own.
    """
    return TileNumbers.of(_numbers(views, frusta), group, rows)


def _numbers(views: Views, frusta: Frusta) -> dict[str, Float]:
    """All numbers of maps that may be tiles, by name, (M,) each."""
    assert frusta.tiles is not None, "a light has several maps"
    forward = zip(_FORWARD, dr.detach(views).forward, strict=True)
    return {**dict(zip(Frusta.names(), frusta.columns(), strict=True)), **frusta.tiles.by_name(), **dict(forward)}


def to_light_space(view: Views, p_world: Point3f) -> Point3f:
    """Coordinates (x, y, z) along a light's axes; z is the distance along ``forward``. Attached to points and light."""
    d = backend(p_world).Array3f(p_world) - view.origin
    return backend(p_world).Array3f(dr.dot(d, view.right), dr.dot(d, view.up), dr.dot(d, view.forward))


def with_depths_from_planes(views: Views, tiles: Tiles | None) -> Views:
    """Views whose depths count from planes with the slopes of the tiles. Attached to the views.

    Points on a ray of light share (x, y): depths along it differ by as much as before, but the depth range of a tile is that
    of the surfaces above and below its plane. ``forward`` is no unit vector then, and no longer the light's direction.
    """
    if tiles is None:
        return views
    forward = views.forward - tiles.slope_x * views.right - tiles.slope_y * views.up
    return replace(views, forward=backend(views.spread).Array3f(forward))


def vertices_in_maps(views: Views, positions: Float) -> tuple[Point3f, UInt32, UInt32]:
    """All vertices in the light space of each map, map after map.

    Args:
        views: of the M maps.
        positions: (3 V,), flat, world space.

    Returns:
        (points of width M * V as from :func:`to_light_space`, attached to positions and lights; map of each; vertex of each).
    """
    module, count = backend(positions), views.count
    number = dr.width(positions) // 3
    lane = dr.arange(module.UInt32, count * number)
    map_index, vertex = split(lane, "vertices", number, count)
    if count == 1:
        map_index = dr.zeros(module.UInt32, number)
    p_world = dr.gather(module.Array3f, positions, vertex)
    return to_light_space(of_map(views, map_index, count), p_world), map_index, vertex


def to_clip(view: Views, frustum: Frusta, p_light: Point3f) -> Vector4f:
    """Clip-space positions in a map: the NDC square is the frustum's rectangle, depths near..far are -1..1. Attached."""
    perspective = view.spread > 0
    n, f = frustum.near, frustum.far
    w = dr.select(perspective, p_light.z, 1.0)
    x = dr.fma(-frustum.center_x, w, p_light.x) / frustum.half_x
    y = dr.fma(-frustum.center_y, w, p_light.y) / frustum.half_y
    a = dr.select(perspective, (f + n) / (f - n), 2 / (f - n))
    b = dr.select(perspective, -2 * f * n / (f - n), -(f + n) / (f - n))
    return backend(p_light).Array4f(x, y, dr.fma(a, p_light.z, b), w)


def linear_depth(view: Views, frustum: Frusta, depth: Float) -> tuple[Float, Float]:
    """Depth along the light's axis, mapped linearly from first..far to -1/2..1/2, and its derivative by ``depth``. Attached.

    ``depth``: NDC depth in parallel projections, 1 / w in perspective. Depths before ``first`` become -1/2, without derivative.
    """
    perspective = view.spread > 0
    n, f, first = frustum.near, frustum.far, frustum.first
    # Empty texels may hold 0: do not divide by it.
    z = dr.rcp(dr.select(perspective & (depth > 0), depth, 1))
    scale = 1 / (f - first)
    z = dr.select(perspective, z, 0.5 * dr.fma(depth, f - n, f + n))
    linear = (z - first) * scale - 0.5
    slope = dr.select(perspective, -z * z, 0.5 * (f - n)) * scale
    told_apart = linear > -0.5
    return dr.select(told_apart, linear, -0.5), dr.select(told_apart, slope, 0)


def project(view: Views, frustum: Frusta, p_world: Point3f) -> tuple[Float, Float, Float, Bool]:
    """Positions of world-space points in a map: (u, v, linear depth, mask of points inside the map), u and v in -1..1.

    Attached to points and light.
    """
    p = to_light_space(view, p_world)
    perspective = view.spread > 0
    in_front = ~perspective | (p.z > 1e-6 * frustum.far)
    w = dr.select(perspective & in_front, p.z, 1.0)
    u = (p.x / w - frustum.center_x) / frustum.half_x
    v = (p.y / w - frustum.center_y) / frustum.half_y
    depth = (p.z - frustum.first) / (frustum.far - frustum.first) - 0.5
    inside = in_front & (dr.abs(u) <= 1) & (dr.abs(v) <= 1)
    return u, v, depth, inside

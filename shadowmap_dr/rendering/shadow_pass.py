"""Shadow maps of a scene's lights: their number, their cameras, and their look-up by pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import ShadowmapError
from ..jit.arrays import device_array
from ..jit.handover import computed
from ..jit.kernel_inputs import split
from ..jit.types import Bool, Color3f, Float, Point3f, UInt32, Vector3f
from ..raster import Topology
from ..scene.geometry import Geometry, rows_of
from ..scene.lights.projected import Beam
from ..scene.lights.read import Light
from ..scene.mitsuba_objects import transmits
from ..shadow import (
    Boxes,
    Frusta,
    Group,
    LightView,
    ShadowMaps,
    ShadowSettings,
    TranslucentCasters,
    Views,
    casting_shapes,
    cube_face,
    filter_maps,
    fit_frusta,
    fit_tiles,
    render_maps,
    shape_bounds,
    shape_boxes,
    stack_views,
    steady_axes,
    tiled_transmittance,
    tiled_visibility,
    transmittance,
    vertices_in_maps,
    vertices_of_maps,
    visibility,
    with_depths_from_planes,
)
from .gbuffer.camera_view import VisiblePoints

# Vertices whose coordinates are looked at at once on the host: temporary arrays of all of them would take longer to allocate.
_PIECE = 1 << 15


@dataclass(frozen=True)
class MapPlan:
    """The maps of each light. Static, made once for a scene.

    ``kinds``: ``directional``, ``beam``, ``spot`` (one map each) or ``cube`` (six). ``tiles``: maps that share the image plane of
    each light, 1 for beams and cubes.
    ``planes``: index of the largest face of each planar shape, of any face for other shapes. ``planar``: Bool (S,).
    ``opaque``: planar shapes that nothing is seen through.
    ``reflecting``: planar shapes that light from behind does not reach: all, unless a material spreads light to its other side.
    ``center``, ``radius``: a sphere around the scene at rest, world space, for the fixed frusta of ``compat``.
    """

    RECORDED_OFTEN: ClassVar[bool] = True  # see `jit.frozen.take_apart`

    kinds: tuple[str, ...]
    tiles: tuple[int, ...]
    planes: UInt32
    planar: Bool
    opaque: Bool
    reflecting: Bool
    center: tuple[float, float, float]
    radius: float

    @property
    def counts(self) -> tuple[int, ...]:
        """Number of maps of each light."""
        return tuple(6 if kind == "cube" else tiles for kind, tiles in zip(self.kinds, self.tiles, strict=True))

    @property
    def first(self) -> tuple[int, ...]:
        """Number of each light's first map."""
        return tuple(accumulate(self.counts, initial=0))[:-1]

    @property
    def maps(self) -> int:
        """Number of maps."""
        return sum(self.counts)

    def settings(self, shadow: ShadowSettings) -> ShadowSettings:
        """Settings of the maps. They are one batch: with tiles among them, all are filtered as tiles."""
        return shadow.of_tiles if self.groups else shadow

    @property
    def undivided(self) -> MapPlan:
        """The plan with one map for each image plane."""
        return replace(self, tiles=(1,) * len(self.tiles))

    @property
    def groups(self) -> tuple[Group, ...]:
        """Maps of the lights that have several tiles."""
        return tuple((first, tiles) for first, tiles in zip(self.first, self.tiles, strict=True) if tiles > 1)

    def part(self, first: int, last: int) -> MapPlan:
        """The maps of the lights from number ``first`` to before number ``last``."""
        return replace(self, kinds=self.kinds[first:last], tiles=self.tiles[first:last])


def plan_maps(lights: Sequence[Light], geometry: Geometry, materials: Sequence[mi.Object]) -> MapPlan:
    """Choose the maps of the lights, and find planar shapes (on the host, once). ``materials``: of the scene."""
    kinds = tuple(light.map_kind() for light in lights)
    positions = dr.detach(geometry.positions).numpy().reshape(-1, 3)
    faces = geometry.faces.numpy().reshape(-1, 3)
    planes = np.array([info.face_start for info in geometry.shapes])
    planar = np.flatnonzero([info.planar for info in geometry.shapes])
    if len(planar):
        rows = rows_of(planes[planar], np.array([geometry.shapes[k].face_count for k in planar]))
        own = positions[faces[rows]].astype(np.float64)
        squared = (np.cross(own[:, 1] - own[:, 0], own[:, 2] - own[:, 0]) ** 2).sum(1)
        # Of each shape the last one that is written stays: the first one of the largest.
        order = np.lexsort((-rows, squared))
        largest = np.empty(len(geometry.shapes), np.int64)
        largest[geometry.face_shape.numpy()[rows[order]]] = rows[order]
        planes[planar] = largest[planar]
    center, radius = _sphere_around(positions)
    opaque = not any(transmits(node) for node in materials)
    return MapPlan(
        kinds,
        (1,) * len(kinds),
        device_array(mi.UInt32, planes),
        device_array(mi.Bool, [info.planar for info in geometry.shapes]),
        device_array(mi.Bool, [info.planar and not info.see_through for info in geometry.shapes]),
        device_array(mi.Bool, [info.planar and opaque for info in geometry.shapes]),
        center,
        radius or 1.0,
    )


def _sphere_around(positions: np.ndarray) -> tuple[tuple[float, float, float], float]:
    """Center of the box around points (V, 3), and the largest distance from it."""
    pieces = [positions[start : start + _PIECE].T for start in range(0, len(positions), _PIECE)]
    low, high = (np.array([[end(column) for column in piece] for piece in pieces], np.float64) for end in (np.min, np.max))
    x, y, z = (0.5 * (low.min(0) + high.max(0))).tolist()
    squared = (sum((column.astype(np.float64) - c) ** 2 for column, c in zip(p, (x, y, z), strict=True)).max() for p in pieces)
    return (x, y, z), float(np.sqrt(max(squared)))


def check_sizes(maps: int, texels: int, geometry: Geometry, lights: str, remedy: str) -> None:
    """ShadowmapError if maps are too many for arrays, whose lanes are counted with 32 bits.

    Args:
        maps: number of maps.
        texels: texels along each side of a map.
        geometry: geometry of the scene.
        lights: name of the lights, for the message.
        remedy: advice, for the message.
    """
    if maps * max(geometry.vertex_count, geometry.face_count, 4 * texels * texels) >= 2**31:
        raise ShadowmapError(
            f"{maps} shadow maps of {lights}, {texels} x {texels} texels, {geometry.face_count} triangles, are too many: "
            f"{remedy}."
        )


def make_maps(
    plan: MapPlan,
    lights: Sequence[Light],
    geometry: Geometry,
    topology: Topology,
    settings: ShadowSettings,
    previous: Frusta | None,
    seen: VisiblePoints | None = None,
    outward: Bool | None = None,
    drawn: Bool | None = None,
    translucent: TranslucentCasters | None = None,
) -> ShadowMaps:
    """Render and filter the maps of all lights as one batch. Attached to lights and vertices.

    ``previous`` is the fit of an earlier call, ``seen`` points on what the cameras see, and the places of these, ``outward``
    faces (Bool, F) of which the maps of directional lights show the fronts only (:func:`shadowmap_dr.raster.outward_faces`),
    ``drawn`` a mask of the opaque faces, and ``translucent`` the casters that are not.
    """
    settings = plan.settings(settings)
    views, p_light, lanes, frusta = _fitted(plan, lights, geometry, settings, previous, seen)
    culled = _culled(plan, views.count, outward)
    maps = render_maps(p_light, lanes, geometry.faces, topology, views, frusta, settings, culled, drawn, translucent)
    return filter_maps(maps)


def fit_maps(
    plan: MapPlan,
    lights: Sequence[Light],
    geometry: Geometry,
    settings: ShadowSettings,
    previous: Frusta | None,
    seen: VisiblePoints | None = None,
) -> Frusta:
    """The fit of the maps of :func:`make_maps`, without rendering them. Arguments as there."""
    return _fitted(plan, lights, geometry, plan.settings(settings), previous, seen)[3]


def map_vertices(
    plan: MapPlan, lights: Sequence[Light], geometry: Geometry, settings: ShadowSettings, frusta: Frusta
) -> tuple[Float, int, int]:
    """(clip-space vertices (4 M V,) of all maps, texels along each side, number M of maps) for a known fit. Detached."""
    settings = plan.settings(settings)
    with dr.suspend_grad():
        each = zip(lights, plan.kinds, plan.tiles, strict=True)
        views = stack_views([view for light, kind, tiles in each for view in _views(plan, light, kind, settings) * tiles])
        p_light, lanes, _ = vertices_in_maps(with_depths_from_planes(views, frusta.tiles), geometry.positions)
        return vertices_of_maps(views, frusta, p_light, lanes), settings.resolution, views.count


def _fitted(
    plan: MapPlan,
    lights: Sequence[Light],
    geometry: Geometry,
    settings: ShadowSettings,
    previous: Frusta | None,
    seen: VisiblePoints | None,
) -> tuple[Views, Point3f, UInt32, Frusta]:
    """(cameras of all maps, light-space vertices, the map of each of these, the fit)."""
    each = zip(lights, plan.kinds, plan.tiles, strict=True)
    stacked = stack_views([view for light, kind, tiles in each for view in _views(plan, light, kind, settings) * tiles])

    def fit() -> Frusta:
        if settings.compat:
            return _compat_frusta(plan, stacked)
        return _fit(plan, lights, geometry, settings, stacked, previous, seen)

    frusta = computed("frusta", fit)
    attached = "directional" in plan.kinds and not settings.compat and dr.grad_enabled(stacked.forward)
    if seen is not None and attached:
        stacked = steady_axes(stacked, frusta, seen[:2])
    stacked = with_depths_from_planes(stacked, frusta.tiles)
    p_light, lanes, _ = vertices_in_maps(stacked, geometry.positions)
    return stacked, p_light, lanes, frusta


def _fit(
    plan: MapPlan,
    lights: Sequence[Light],
    geometry: Geometry,
    settings: ShadowSettings,
    views: Views,
    previous: Frusta | None,
    seen: VisiblePoints | None,
) -> Frusta:
    """Frusta of the maps of all lights. Detached."""
    points = None if seen is None else seen[:2]
    tiles = None
    if plan.groups:
        assert points is not None, "lights have tiles only if visible points are known"
        earlier = None if previous is None else previous.tiles
        tiles = fit_tiles(views, plan.groups, points, earlier, planes=settings.counts_from_planes)
    planes, planar = shape_planes(plan, geometry)
    casts = casting_shapes(views, planes, planar, boxes_of(geometry), eyes=None if seen is None else seen[2], opaque=plan.opaque)
    views = with_depths_from_planes(views, tiles)
    with dr.suspend_grad():
        p_light, lanes, vertex = vertices_in_maps(views, geometry.positions)
        shape = dr.gather(mi.UInt32, geometry.vertex_shape, vertex)
    bounds = shape_bounds(views, _within_beams(plan, lights, p_light, lanes), lanes, shape, len(geometry.shapes))
    frusta = fit_frusta(
        views,
        bounds,
        casts,
        len(geometry.shapes),
        settings.resolution,
        settings.filter_size,
        previous,
        points,
        settings.receiver_range,
        tiles,
    )
    return _from_beams_on(plan, lights, frusta)


def _culled(plan: MapPlan, count: int, outward: Bool | None) -> Bool | None:
    """Faces of each map (Bool, for all maps or for all faces of each) of which only fronts are drawn, or None.

    Only maps of directional lights begin before all casters. Other maps may begin inside of a caster and see its back faces.
    """
    each = zip(plan.kinds, plan.first, plan.tiles, strict=True)
    directional = [first + k for kind, first, tiles in each if kind == "directional" for k in range(tiles)]
    if outward is None or not directional:
        return None
    if len(directional) == count:
        return outward
    faces = dr.width(outward)
    lane = dr.arange(mi.UInt32, count * faces)
    which, face = split(lane, "faces", faces, count)
    chosen = mi.Bool(False)
    for first in directional:
        chosen |= which == first
    return chosen & dr.gather(mi.Bool, outward, face)


def _views(plan: MapPlan, light: Light, kind: str, settings: ShadowSettings) -> tuple[LightView, ...]:
    views = light.map_views(kind, settings.resolution, settings.filter_size)
    if kind != "directional" or not settings.compat:
        return views
    # The authors' camera stands outside of the scene, facing its centre.
    (view,) = views
    origin = mi.Point3f(*plan.center) - view.forward * (2 * plan.radius)
    return (LightView(view.right, view.up, view.forward, origin, view.spread),)


def _within_beams(plan: MapPlan, lights: Sequence[Light], p_light: Point3f, map_index: UInt32) -> Point3f:
    """Light-space points; in maps of beams each is moved to the nearest point that the beam reaches."""
    result = p_light
    for k, light in enumerate(lights):
        if isinstance(light, Beam):
            reach, start = dr.detach(light.reach), light.caster_start
            x, y = dr.clip(p_light.x, -reach, reach), dr.clip(p_light.y, -reach, reach)
            moved = type(p_light)(x, y, dr.maximum(p_light.z, start))
            result = dr.select(map_index == plan.first[k], moved, result)
    return result


def _from_beams_on(plan: MapPlan, lights: Sequence[Light], frusta: Frusta) -> Frusta:
    """Frusta that begin in front of a beam's shape, so that what lies behind it casts no shadow, nor the shape itself."""
    if "beam" not in plan.kinds:
        return frusta
    index = dr.arange(mi.UInt32, dr.width(frusta.near))
    start = mi.Float(-dr.inf)
    for light, first in zip(lights, plan.first, strict=True):
        if isinstance(light, Beam):
            start = dr.select(index == first, light.caster_start, start)
    near = dr.maximum(frusta.near, start)
    nearest = dr.maximum(frusta.first, near)
    least = nearest + 0.1 * dr.maximum(start, 0)
    frusta = replace(frusta, near=near, first=nearest, far=dr.maximum(frusta.far, least), last=dr.maximum(frusta.last, least))
    dr.eval(frusta)
    return frusta


def _compat_frusta(plan: MapPlan, views: Views) -> Frusta:
    """Fixed frusta that hold the whole scene, whatever moves in it."""
    spread = dr.detach(views.spread)
    zero = dr.zeros(mi.Float, views.count)
    half = dr.select(spread > 0, spread, 1.2 * plan.radius)
    near, far = zero + 0.01 * plan.radius, zero + 4 * plan.radius
    return Frusta(zero, zero, half, half, near, far, near, far)


def boxes_of(geometry: Geometry) -> Boxes:
    """Boxes of the shapes where they are now."""
    vertex = dr.arange(mi.UInt32, geometry.vertex_count)
    p_world = dr.gather(mi.Point3f, dr.detach(geometry.positions), vertex)
    return shape_boxes(p_world, geometry.vertex_shape, len(geometry.shapes))


def shape_planes(plan: MapPlan, geometry: Geometry) -> tuple[tuple[Vector3f, Point3f], Bool]:
    """((unit normal, point), whether it is one (Bool)) of the plane of each shape where it is now, detached, world space."""
    planes = _planes(plan, geometry)
    return planes, _still_planar(plan, geometry, planes)


def _planes(plan: MapPlan, geometry: Geometry) -> tuple[Vector3f, Point3f]:
    """(unit normal, point) of each planar shape where it is now, detached, world space."""
    with dr.suspend_grad():
        first, e1, e2 = geometry.triangle(dr.gather(mi.Vector3u, geometry.faces, plan.planes))
        normal = dr.cross(e1, e2)
        length = dr.norm(normal)
        return normal / dr.select(length > 0, length, 1), first


def _still_planar(plan: MapPlan, geometry: Geometry, planes: tuple[Vector3f, Point3f]) -> Bool:
    """Shapes that were planar at rest and still are (Bool, S): vertices may have moved out of the plane since."""
    if all(not info.planar or geometry.known_unchanged(info) for info in geometry.shapes):
        return plan.planar
    with dr.suspend_grad():
        vertex = dr.arange(mi.UInt32, geometry.vertex_count)
        shape = geometry.vertex_shape
        p = dr.gather(mi.Point3f, dr.detach(geometry.positions), vertex)
        normal, point = (mi.Vector3f(*(dr.gather(mi.Float, v[c], shape) for c in range(3))) for v in planes)
        farthest = dr.zeros(mi.Float, len(geometry.shapes))
        dr.scatter_reduce(dr.ReduceOp.Max, farthest, dr.abs(dr.dot(normal, mi.Vector3f(p) - point)), shape)
        return plan.planar & (farthest <= 1e-4 * plan.radius)


def arriving_light(maps: ShadowMaps, plan: MapPlan, light: Light, index: int, p_world: Point3f, active: Bool) -> Float | Color3f:
    """Share of the light of light number ``index`` that reaches world-space points: visibility, times the colour that translucent
    casters let through if there are any. Attached to points, casters and light.
    """
    lit = visibility_of(maps, plan, light, index, p_world, active)
    return lit if maps.transmittance is None else lit * light_through(maps, plan, light, index, p_world, active)


def visibility_of(maps: ShadowMaps, plan: MapPlan, light: Light, index: int, p_world: Point3f, active: Bool) -> Float:
    """Share of the light of light number ``index`` that no opaque caster keeps from world-space points. Attached to points,
    casters and light.
    """
    if plan.tiles[index] == 1:
        return visibility(maps, _map_at(plan, light, index, p_world), p_world, active)
    return tiled_visibility(maps, (plan.first[index], plan.tiles[index]), p_world, active)


def light_through(maps: ShadowMaps, plan: MapPlan, light: Light, index: int, p_world: Point3f, active: Bool) -> Color3f:
    """Share of the light of light number ``index`` that translucent casters let through to world-space points. Attached."""
    if plan.tiles[index] == 1:
        return mi.UnpolarizedSpectrum(*transmittance(maps, _map_at(plan, light, index, p_world), p_world, active))
    group = plan.first[index], plan.tiles[index]
    return mi.UnpolarizedSpectrum(*tiled_transmittance(maps, group, p_world, active))


def share_through(maps: ShadowMaps, map_index: UInt32, p_world: Point3f, active: Bool) -> Float | Color3f:
    """As :func:`arriving_light`, for points that look the map ``map_index`` (``UInt32``, for each point) up."""
    lit = visibility(maps, map_index, p_world, active)
    if maps.transmittance is None:
        return lit
    return lit * mi.UnpolarizedSpectrum(*transmittance(maps, map_index, p_world, active))


def _map_at(plan: MapPlan, light: Light, index: int, p_world: Point3f) -> UInt32:
    """Map of a light without tiles in which each point lies."""
    if plan.kinds[index] == "cube":
        punctual: Any = light  # Any: of the records, those with six maps have a position
        return plan.first[index] + cube_face(dr.detach(mi.Vector3f(p_world - punctual.position)))
    # Wide, although it is one number: adjoints of look-ups with it then run in one kernel, others in one for each number.
    return dr.full(mi.UInt32, plan.first[index], dr.width(p_world))

"""Shadow maps of light samples, one for each sample. All maps of a scene are one batch."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...jit.handover import computed
from ...jit.kernel_inputs import split
from ...jit.types import Bool, Float, Point3f, UInt32, Vector3f
from ...raster import Topology
from ...scene.geometry import Geometry
from ...scene.lights.area import AreaLight
from ...scene.lights.environment import Environment
from ...scene.sensor import Sensor
from ...shadow import (
    Frusta,
    ShadowMaps,
    ShadowSettings,
    TranslucentCasters,
    Views,
    casting_shapes,
    cube_face,
    cube_views,
    directional_view,
    filter_maps,
    fit_frusta,
    receiving_shapes,
    render_maps,
    shape_bounds,
    to_light_space,
    vertices_in_maps,
    vertices_of_maps,
)
from ...shadow.light_camera import of_map
from ..gbuffer.camera_clip import eye_of
from ..gbuffer.camera_view import VisiblePoints
from ..shadow_pass import MapPlan, boxes_of, check_sizes, shape_planes
from .area_samples import AreaPlan, area_samples, plan_area
from .map_aim import WIDEST, Points, aim, sees_all, shape_vertices
from .near_maps import lies_within, near_points, want_near_maps
from .penumbra import Pyramid
from .sample_counts import area_light_count, spread_points
from .samples import LightSamples, SampleTable
from .sky_samples import SkyPlan, plan_sky, sky_samples

SoftLight = AreaLight | Environment
SoftFrusta = tuple[Frusta | None, Frusta | None]

#: No shape is left out of a map.
NO_SHAPE = 0xFFFFFFFF
# Seen points that the fit of a map looks at.
_SEEN = 1024


@dataclass(frozen=True)
class SoftPlan:
    """Samples of one extended light, and their maps. Static.

    ``kind``: ``distant`` or ``near`` (one map for each sample), ``cube`` (six), or ``single`` (one in all, see
    :mod:`shadowmap_dr.rendering.extended_lights.penumbra`). ``first``: number of the first map, single ones and others counted
    apart. ``target``: point that the maps of a ``near`` or ``single`` light face, in the middle of the shapes ``casters``.
    ``hides``: shape that casts no shadow of this light: its own, unless parts of it see others of it, ``facing``; then these cast
    shadows with the sides that shine. ``doubled``: each sample of a ``distant`` light has
    two maps, see :mod:`.near_maps`.
    """

    RECORDED_OFTEN: ClassVar[bool] = True  # see `jit.frozen.take_apart`

    parts: AreaPlan | SkyPlan
    kind: str
    count: int
    first: int
    target: tuple[float, float, float]
    hides: int
    facing: tuple[int, int] = (0, 0)
    casters: tuple[int, ...] = ()
    doubled: bool = False

    @property
    def maps(self) -> int:
        """Number of its maps."""
        return 1 if self.kind == "single" else self.count * (6 if self.kind == "cube" else 1 + self.doubled)


def plan_soft(
    lights: Sequence[SoftLight],
    geometry: Geometry,
    area_count: int | None,
    sky_count: int,
    single: bool = False,
    cameras: Sequence[Sensor] = (),
) -> tuple[SoftPlan, ...]:
    """Choose samples of the lights, and their maps (on the host, once).

    Args:
        lights: the lights.
        geometry: of the scene.
        area_count, sky_count: samples of each area light, of an environment. ``area_count`` None: as many as ``cameras`` need.
        single: area lights get one map if one suffices.
        cameras: cameras of the scene.
    """
    plans: list[SoftPlan] = []
    first = {True: 0, False: 0}
    receivers: tuple[Points, npt.NDArray[np.uint32]] | None = None
    eyes = np.concatenate([np.zeros((0, 4)), *(np.array(eye_of(camera), np.float64).reshape(1, 4) for camera in cameras)])
    for light in lights:
        if isinstance(light, Environment):
            receivers = _receivers(geometry) if receivers is None else receivers
            doubled = want_near_maps(geometry, receivers[0], cameras)
            plan = SoftPlan(
                plan_sky(light, sky_count, geometry), "distant", sky_count, 0, (0.0, 0.0, 0.0), NO_SHAPE, doubled=doubled
            )
        else:
            vertices = shape_vertices(geometry)
            aimed = aim(vertices, geometry.shapes, light.shape, eyes)
            kind = "cube" if aimed.surrounded else "single" if single else "near"
            count = area_count
            if count is None:
                receivers = _receivers(geometry) if receivers is None else receivers
                others = receivers[0][receivers[1] != light.shape]
                count = area_light_count(vertices[light.shape], [vertices[k] for k in aimed.casters], others, cameras)
            parts = plan_area(light, geometry, count)
            plan = SoftPlan(parts, kind, count, 0, aimed.target, light.shape, casters=aimed.casters)
            if kind != "single" and parts.dented:
                info = geometry.shapes[light.shape]
                plan = replace(plan, kind="cube", hides=NO_SHAPE, facing=(info.face_start, info.face_start + info.face_count))
        alone = plan.kind == "single"
        plans.append(replace(plan, first=first[alone]))
        first[alone] += plan.maps
    return tuple(plans)


def _receivers(geometry: Geometry) -> tuple[Points, npt.NDArray[np.uint32]]:
    """Points (R, 3) spread over all surfaces, and the shape of each (R,)."""
    positions, faces = geometry.positions, geometry.faces
    points, face = spread_points(dr.detach(positions).numpy().reshape(-1, 3), faces.numpy().reshape(-1, 3))
    return points, geometry.face_shape.numpy()[face]


def still_aimed(plans: Sequence[SoftPlan], geometry: Callable[[], Geometry]) -> bool:
    """True if the maps of ``near`` and ``single`` lights still cover their casters.

    Calls ``geometry`` and reads its vertices back only if there are such lights.
    """
    aimed = [plan for plan in plans if plan.kind in ("near", "single")]
    vertices = shape_vertices(geometry()) if aimed else []
    return all(sees_all(vertices[plan.hides], [vertices[k] for k in plan.casters], plan.target) for plan in aimed)


def check_soft_sizes(plans: Sequence[SoftPlan], geometry: Geometry, texels: int) -> None:
    """ShadowmapError if maps are too many for arrays."""
    remedy = "lower area_light_samples, environment_light_samples or soft_map_resolution"
    check_sizes(sum(plan.maps for plan in plans), texels, geometry, "extended lights", remedy)


def samples_of(light: SoftLight, plan: SoftPlan, geometry: Geometry) -> LightSamples:
    """Current samples of a light. Attached."""
    if isinstance(light, Environment):
        assert isinstance(plan.parts, SkyPlan)
        return sky_samples(light, plan.parts)
    assert isinstance(plan.parts, AreaPlan)
    return area_samples(light, plan.parts, geometry)


@dataclass(frozen=True)
class SoftMaps:
    """The maps of all extended lights: ``sampled``, one for each sample, and ``single``, one for each light; or None."""

    sampled: ShadowMaps | None
    single: Pyramid | None

    @property
    def frusta(self) -> SoftFrusta:
        """Their fit."""
        return (
            None if self.sampled is None else self.sampled.frusta,
            None if self.single is None else self.single.maps.frusta,
        )


def make_soft_maps(
    plans: Sequence[SoftPlan],
    samples: Sequence[LightSamples],
    scene: MapPlan,
    geometry: Geometry,
    topology: Topology,
    settings: tuple[ShadowSettings, ShadowSettings],
    previous: SoftFrusta,
    seen: VisiblePoints | None = None,
    drawn: Bool | None = None,
    translucent: TranslucentCasters | None = None,
) -> SoftMaps:
    """Render and filter the maps of all samples as one batch, and those of single ones as another. Attached to samples, vertices.

    ``scene``: planes of the shapes. ``settings``: for either kind of map. ``previous``: fit of an earlier call. For other
    arguments see :func:`shadowmap_dr.rendering.shadow_pass.make_maps`.
    """
    made: list[ShadowMaps | None] = []
    for own, setting, fit in _kinds(plans, samples, settings, previous):
        made.append(_make(own, scene, geometry, topology, setting, fit, seen, (drawn, translucent)) if own else None)
    sampled, single = made
    return SoftMaps(None if sampled is None else filter_maps(sampled), None if single is None else Pyramid.of(single))


def fit_soft_maps(
    plans: Sequence[SoftPlan],
    samples: Sequence[LightSamples],
    scene: MapPlan,
    geometry: Geometry,
    settings: tuple[ShadowSettings, ShadowSettings],
    previous: SoftFrusta,
    seen: VisiblePoints | None = None,
) -> SoftFrusta:
    """The fit of the maps of :func:`make_soft_maps`, without rendering them. Arguments as there."""
    kinds = _kinds(plans, samples, settings, previous)
    sampled, single = (_fitted(own, scene, geometry, setting, fit, seen)[2] if own else None for own, setting, fit in kinds)
    return sampled, single


_Parts = Sequence[tuple[SoftPlan, LightSamples]]


def _kinds(
    plans: Sequence[SoftPlan],
    samples: Sequence[LightSamples],
    settings: tuple[ShadowSettings, ShadowSettings],
    previous: SoftFrusta,
) -> Iterator[tuple[_Parts, ShadowSettings, Frusta | None]]:
    """(lights, settings of their maps, fit of an earlier call), for maps of samples, then for single maps."""
    for single, setting, fit in zip((False, True), settings, previous, strict=True):
        yield [(p, s) for p, s in zip(plans, samples, strict=True) if (p.kind == "single") == single], setting, fit


def _fitted(
    lights: _Parts,
    scene: MapPlan,
    geometry: Geometry,
    settings: ShadowSettings,
    previous: Frusta | None,
    seen: VisiblePoints | None,
) -> tuple[Views, UInt32, Frusta]:
    """(cameras of all maps, hidden shape of each map, the fit)."""
    plans = [plan for plan, _ in lights]
    views = _stack([_views(plan, s, settings) for plan, s in lights])
    hidden = dr.concat([dr.full(mi.UInt32, plan.hides, plan.maps) for plan in plans])
    dr.eval(views, hidden)
    nearer = _serve_near_points(plans) if any(plan.doubled for plan in plans) else None
    frusta = computed("frusta of extended lights", lambda: _fit(views, hidden, scene, geometry, settings, previous, seen, nearer))
    return views, hidden, frusta


def _make(
    lights: _Parts,
    scene: MapPlan,
    geometry: Geometry,
    topology: Topology,
    settings: ShadowSettings,
    previous: Frusta | None,
    seen: VisiblePoints | None,
    casters: tuple[Bool | None, TranslucentCasters | None],
) -> ShadowMaps:
    """Unfiltered maps of some lights. ``casters``: mask of the opaque faces, and the other casters."""
    plans = [plan for plan, _ in lights]
    views, hidden, frusta = _fitted(lights, scene, geometry, settings, previous, seen)
    p_light, which, vertex = vertices_in_maps(views, geometry.positions)
    if any(plan.hides != NO_SHAPE for plan in plans):
        own = dr.gather(mi.UInt32, hidden, which) == dr.gather(mi.UInt32, geometry.vertex_shape, vertex)
        # Behind the light's camera, where no triangle is drawn.
        p_light = dr.select(own, type(p_light)(0, 0, -1), p_light)
    culled = _facing(plans, geometry)
    return render_maps(p_light, which, geometry.faces, topology, views, frusta, settings, culled, *casters)


def soft_map_vertices(
    plans: Sequence[SoftPlan],
    samples: Sequence[LightSamples],
    geometry: Geometry,
    settings: tuple[ShadowSettings, ShadowSettings],
    frusta: SoftFrusta,
) -> list[tuple[Float, int, int]]:
    """As :func:`~shadowmap_dr.rendering.shadow_pass.map_vertices`, for the maps of samples, and for single ones."""
    found = []
    with dr.suspend_grad():
        for own, setting, fit in _kinds(plans, samples, settings, frusta):
            if own and fit is not None:
                views = _stack([_views(plan, s, setting) for plan, s in own])
                p_light, which, _ = vertices_in_maps(views, geometry.positions)
                found.append((vertices_of_maps(views, fit, p_light, which), setting.resolution, views.count))
    return found


def _facing(plans: Sequence[SoftPlan], geometry: Geometry) -> Bool | None:
    """Mask (Bool, all faces of each map) of faces that cast shadows only where they face the light, or None."""
    if not any(plan.facing[1] for plan in plans):
        return None
    first, last = (dr.concat([dr.full(mi.UInt32, plan.facing[k], plan.maps) for plan in plans]) for k in range(2))
    lane = dr.arange(mi.UInt32, dr.width(first) * geometry.face_count)
    which, face = split(lane, "faces", geometry.face_count, dr.width(first))
    return (face >= dr.gather(mi.UInt32, first, which)) & (face < dr.gather(mi.UInt32, last, which))


def _serve_near_points(plans: Sequence[SoftPlan]) -> Bool:
    """Mask of the maps that serve points near the cameras alone."""
    return dr.concat([mi.Bool((dr.arange(mi.UInt32, plan.maps) & 1) == 1) & plan.doubled for plan in plans])


def map_of(plan: SoftPlan, table: SampleTable, sample: UInt32, p_world: Point3f, maps: ShadowMaps) -> UInt32:
    """Index of the map (UInt32), one of ``maps``, in which points look up the visibility of a sample (UInt32)."""
    if plan.doubled:
        far = plan.first + 2 * sample
        return dr.select(lies_within(maps, far + 1, p_world), far + 1, far)
    if plan.kind == "cube":
        return plan.first + sample * 6 + cube_face(dr.detach(mi.Vector3f(p_world) - table.place(sample)))
    return plan.first + sample


def _views(plan: SoftPlan, samples: LightSamples, settings: ShadowSettings) -> Views:
    """Cameras of a light's samples, attached to their places and directions."""
    count = plan.maps
    zero = dr.zeros(mi.Float, count)
    if plan.kind == "distant":
        place = samples.place
        if plan.doubled:
            sample = dr.arange(mi.UInt32, count) // 2
            place = type(place)(*(dr.gather(mi.Float, place[c], sample) for c in range(3)))
        view = directional_view(place)
        return Views(view.right, view.up, view.forward, mi.Vector3f(zero), zero, zero + dr.inf)
    if plan.kind in ("near", "single"):
        place = samples.centre() if plan.kind == "single" else samples.place
        # Which way a camera faces has no influence on what it sees, so it need not be differentiated.
        with dr.suspend_grad():
            view = directional_view(mi.Vector3f(*plan.target) - dr.detach(place))
        spread = dr.full(mi.Float, math.tan(math.radians(WIDEST)), count)
        return Views(view.right, view.up, view.forward, place, spread, zero + dr.inf)
    lane = dr.arange(mi.UInt32, count)
    sample, face = lane // 6, lane % 6
    faces = cube_views(mi.Point3f(0), settings.resolution, settings.filter_size)

    def pick(name: str) -> Vector3f:
        total = mi.Vector3f(0)
        for k, view in enumerate(faces):
            total = dr.select(face == k, mi.Vector3f(getattr(view, name)), total)
        return total

    origin = mi.Vector3f(*(dr.gather(mi.Float, samples.place[c], sample) for c in range(3)))
    spread = dr.full(mi.Float, 0, count) + faces[0].spread
    return Views(pick("right"), pick("up"), pick("forward"), origin, spread, spread)


def _stack(parts: list[Views]) -> Views:
    """One batch of all cameras."""
    if len(parts) == 1:
        return parts[0]

    def vectors(values: list[Vector3f]) -> Vector3f:
        return mi.Vector3f(*(dr.concat([mi.Float(v[c]) for v in values]) for c in range(3)))

    return Views(
        right=vectors([part.right for part in parts]),
        up=vectors([part.up for part in parts]),
        forward=vectors([part.forward for part in parts]),
        origin=vectors([part.origin for part in parts]),
        spread=dr.concat([part.spread for part in parts]),
        limit=dr.concat([part.limit for part in parts]),
    )


def _fit(
    views: Views,
    hidden: UInt32,
    scene: MapPlan,
    geometry: Geometry,
    settings: ShadowSettings,
    previous: Frusta | None,
    seen: VisiblePoints | None,
    nearer: Bool | None = None,
) -> Frusta:
    """Frusta around the boxes of shapes. With many maps, a fit to each vertex would cost more than drawing it.

    ``nearer``: mask of the maps that serve points near the cameras alone.
    """
    with dr.suspend_grad():
        shapes, count = len(geometry.shapes), views.count
        boxes = boxes_of(geometry)
        lane = dr.arange(mi.UInt32, count * shapes * 8)
        entry = lane >> 3
        which, shape = split(entry, "shapes", shapes, count)
        corner = boxes.corners(shape, lane & 7)
        bounds = shape_bounds(views, to_light_space(of_map(dr.detach(views), which, count), corner), which, shape, shapes)
        planes, planar = shape_planes(scene, geometry)
        eyes = None if seen is None else seen[2]
        casts = casting_shapes(views, planes, planar, boxes, hidden, eyes, scene.opaque)
        receives = None if eyes is None else receiving_shapes(views, planes, planar & scene.reflecting, eyes)
        few = _few(seen)
        chosen = None if few is None or eyes is None or nearer is None else (nearer, near_points(few, eyes))
        return fit_frusta(
            views,
            bounds,
            casts,
            shapes,
            settings.resolution,
            settings.filter_size,
            previous,
            few,
            settings.receiver_range,
            receives=receives,
            nearer=chosen,
        )


def _few(seen: VisiblePoints | None) -> tuple[Point3f, Bool] | None:
    """A subset of about 1,000 visible points."""
    if seen is None:
        return None
    points, active, _ = seen
    stride = max(1, dr.width(points) // _SEEN)
    # Odd steps do not run down the columns of an image.
    stride += stride > 1 and stride % 2 == 0
    index = dr.arange(mi.UInt32, dr.width(points) // stride) * stride
    return mi.Point3f(*(dr.gather(mi.Float, points[c], index) for c in range(3))), dr.gather(mi.Bool, mi.Bool(active), index)
